"""Linear models of volumes on the device: storage buffers, and passes of compute shaders."""
