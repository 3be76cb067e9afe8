"""Tools without a domain: files, tensors, processes, optional packages."""
