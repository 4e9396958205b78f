"""Editor of the curve that maps the intensity of an image to stiffness."""
