"""The command `falsework`: one module per subcommand, each a frozen dataclass that tyro fills in.

Subcommands import the rest of the package when they run, so that `falsework --help` answers at once.
"""
