"""Policies that propose the next action from any state: data, networks, training, evaluation, replanning."""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
