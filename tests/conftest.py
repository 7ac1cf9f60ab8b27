"""One thread for torch: networks here are small, and results then do not depend on the machine's cores."""

import torch

torch.set_num_threads(1)
