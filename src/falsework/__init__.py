"""Plan how robots build structures of rigid blocks with nothing but their grippers as falsework."""

from falsework._version import __version__ as __version__
