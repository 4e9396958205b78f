"""Phantoms, demonstrations and the self-test."""
