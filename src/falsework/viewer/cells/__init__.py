"""Pages and pictures of cells, also of those that are not valid yet."""
