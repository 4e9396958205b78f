"""OpenGL context of the compute thread, and the device that uses it."""
