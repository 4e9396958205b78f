"""Entry point of ``python -m napari_hmrf``, which is equivalent to the command ``napari-hmrf``."""

import sys

from napari_hmrf.cli import main

if __name__ == "__main__":
    sys.exit(main())
