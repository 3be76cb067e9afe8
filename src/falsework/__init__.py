"""Assembly planning for rigid-block structures, with robots as temporary supports and certified stability."""

from falsework._version import __version__ as __version__
from falsework.assembly.load import register_reader as _register_reader
from falsework.utils.lazy import lazy_exports as _lazy_exports

__getattr__, __dir__, __all__ = _lazy_exports(__name__)

# Formats of other programs; they are read by a package that `assembly` must not know.
_register_reader("falsework.interop.compas_read:is_compas", "falsework.interop.compas_read:load_compas")
