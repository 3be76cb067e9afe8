"""Plan how robots build structures of rigid blocks with nothing but their grippers as falsework."""

__version__ = "0.1.0"
