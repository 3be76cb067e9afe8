"""Assembly planning for rigid-block structures, with robots as temporary supports and certified stability."""

from falsework._version import __version__ as __version__
from falsework.utils.display.drawing import register_drawers as _register_drawers
from falsework.utils.lazy import lazy_exports as _lazy_exports

__getattr__, __dir__, __all__ = _lazy_exports(__name__)

# Pictures are drawn by a package that those of the objects must not know.
_register_drawers(html="falsework.viewer.notebook:html_of", state="falsework.viewer.pictures.contact_sheet:state_frame")
