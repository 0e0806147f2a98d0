"""The native core: one control step in C99, and its ctypes binding."""
