"""OpenGL context of the compute thread, and the device that owns the context."""
