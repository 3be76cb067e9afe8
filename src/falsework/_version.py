"""The one place that states the version: packaging and `falsework.__version__` read it here."""

__version__ = "0.2.0.dev0"
