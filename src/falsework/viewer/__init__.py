"""Pictures, videos, and the page in the browser, of plans, runs, robot plans, state graphs and structures."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
