"""Contact patches between part meshes."""
