"""Linear models of images on the device: textures, and passes of shaders over them."""
