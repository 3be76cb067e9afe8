"""Plans with repeated holds and props: searches over states in which parts are held, released and held again."""
