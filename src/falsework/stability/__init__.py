"""Does a partial structure stand while robots hold some of its parts? With a proof either way."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
