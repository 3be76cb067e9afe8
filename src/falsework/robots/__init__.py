"""Robot arms: cells, collision checking, motion planning, grasps and robot plans."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
