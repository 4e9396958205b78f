"""How long a test waits for what will come: a safety net, and no claim about speed."""

#: Seconds that are enough to compile every kernel anew on a busy machine.
LONG = 240.0
#: As milliseconds, for Qt.
LONG_MS = int(1000 * LONG)
