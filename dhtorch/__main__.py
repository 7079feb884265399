"""``python -m dhtorch`` is the ``dhtorch`` command."""

import sys

from dhtorch.commands.run import main

sys.exit(main())
