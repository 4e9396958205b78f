"""Linear models of images on the device: textures, and shader passes over the textures."""
