"""Test-wide settings."""

from __future__ import annotations

import signal

import torch

# As in training: at these sizes a second thread only waits for the first.
torch.set_num_threads(1)

# A suite that is started in the background or with nohup inherits ignored signals, which trainers
# respect: what signals do could not be tested.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
for _number in (signal.SIGTERM, signal.SIGHUP):
    if signal.getsignal(_number) == signal.SIG_IGN:
        signal.signal(_number, signal.SIG_DFL)
