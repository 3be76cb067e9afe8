"""Colours of all pictures; the robots' are told apart by colour-blind people too (Okabe and Ito)."""

SAND = "#dccdb2"
BOUNDARY = "#56585c"
INK = "#22252a"
ROBOTS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9")
FORCE = "#d55e00"
GRAVITY = "#22252a"
