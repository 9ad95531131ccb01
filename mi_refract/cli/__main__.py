"""`python -m mi_refract.cli`."""

import sys

from . import main

sys.exit(main())
