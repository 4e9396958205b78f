"""Timeouts of tests: generous limits, which state nothing about speed."""

#: Seconds that are enough to compile every kernel on a busy machine.
LONG = 240.0
#: The same in milliseconds, for Qt.
LONG_MS = int(1000 * LONG)
