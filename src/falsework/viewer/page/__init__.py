"""Interactive page in the browser, served by viser."""
