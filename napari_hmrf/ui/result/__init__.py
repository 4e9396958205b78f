"""The part of the dock that shows the result."""
