"""Plans with holding again: searches over states in which parts are held, let go and held again, and props placed."""
