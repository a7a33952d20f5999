"""Measurements against peers and bare kernels, taken side by side in one run."""
