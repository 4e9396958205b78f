"""Linear models of volumes on the device: storage buffers, and compute shader passes."""
