"""Replanning under a deadline: a plan from any state to any target, by policy, search or both."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
