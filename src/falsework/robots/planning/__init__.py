"""Task and motion planning: from abstract plans to arm motions."""
