"""Phantoms, the demonstration and the self-test."""
