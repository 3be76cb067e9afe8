"""Structures and plans for other programs: glTF, COMPAS, USD, and assembly instructions for a crew."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
