"""Editor for the curve that maps the intensity of an image to stiffness."""
