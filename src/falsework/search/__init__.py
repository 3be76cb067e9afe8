"""Plans: in which order to hold and remove parts so that every state on the way is stable."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
