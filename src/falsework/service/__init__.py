"""Replanning and verdicts over HTTP for one structure, bounded in size and time, with proofs.

`app` defines the routes, `middleware` and `server` refuse bad requests, `pool` distributes the work among processes
that `worker` runs, and batches requests that arrive together.
"""

from falsework.utils.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__)
