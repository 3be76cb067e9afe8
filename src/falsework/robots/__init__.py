"""Real arms: cells, collisions, motions, grasps and the plans that robots carry out."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, extra="robots")
