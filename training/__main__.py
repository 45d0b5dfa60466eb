"""`python -m training fit ...` is `mrbokeh train fit ...`: torchrun starts modules more easily than console scripts."""

import sys

from mrbokeh.cli import main

if __name__ == "__main__":
    sys.argv.insert(1, "train")
    main()
