"""Independent stability methods from other fields, which share no code with the solvers."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
