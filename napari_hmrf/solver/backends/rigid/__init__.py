"""Rigid bodies: their sites, their poses, and the motion that they induce around them."""
