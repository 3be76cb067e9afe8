"""Cache of compiled code: its folder, and numba's files in it, with digests."""
