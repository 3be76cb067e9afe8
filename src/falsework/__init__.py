"""Assembly planning for rigid-block structures, with robots as temporary supports and certified stability."""

from falsework._version import __version__ as __version__
from falsework.utils.display.frame import register_painter as _register_painter
from falsework.utils.display.notebook import register_display as _register_display
from falsework.utils.lazy import lazy_exports as _lazy_exports

__getattr__, __dir__, __all__ = _lazy_exports(__name__)

# Pictures are drawn by a package that those of the objects must not know.
_register_display("falsework.viewer.notebook:html_of")
_register_painter("falsework.viewer.pictures.contact_sheet:state_frame")
