"""Stability of partial structures with held parts, with a certificate for each verdict."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
