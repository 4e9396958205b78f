"""OpenGL context of the compute thread, and the device behind it."""
