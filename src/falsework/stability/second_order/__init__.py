"""Rest positions to second order: contact points as springs, motions that grow, and the proof of one."""
