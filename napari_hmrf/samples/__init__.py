"""Phantoms, demonstrations and the self-test."""

from typing import Literal

PhantomName = Literal["expansion", "mass-effect", "bar"]
