"""`python -m tests.validation`, from the root of a checkout."""

import sys

from .runner import main

if __name__ == "__main__":
    sys.exit(main())
