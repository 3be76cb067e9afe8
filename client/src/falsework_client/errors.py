"""The exception of this package."""


class ClientError(Exception):
    """Request that cannot be answered; the message is one line that names the fault and the remedy."""
