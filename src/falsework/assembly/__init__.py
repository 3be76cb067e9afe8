"""The structure to build: an immutable assembly, states of it, and files."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
