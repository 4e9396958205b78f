"""The dock widget *Look at the result*."""
