"""CUDA C++ of the GPU solver, in files that are joined in the order of `driver.SOURCES`."""
