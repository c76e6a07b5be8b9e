"""numba_kernels"""
