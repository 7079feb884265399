"""One thread for every test: answers are then equal bit for bit, and a busy machine does not slow them down.

Every test and what it starts hears Ctrl-C, too: a shell has it ignored by what runs in its background.
"""

import signal

import torch

torch.set_num_threads(1)
signal.signal(signal.SIGINT, signal.default_int_handler)
