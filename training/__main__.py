"""Entry point for torchrun, which starts modules more easily than scripts: `python -m training fit ...` is `mrbokeh train fit ...`."""

import sys

from mrbokeh.cli import main

if __name__ == "__main__":
    sys.argv.insert(1, "train")
    main()
