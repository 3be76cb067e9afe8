"""Assembly sequence planning: searches for sequences of actions whose states are all stable."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
