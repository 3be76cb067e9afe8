"""Geometry of parts: meshes, masses, contacts and clearance, independent of stability."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
