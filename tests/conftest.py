"""As in the benchmark's processes: one thread, so that results do not depend on the machine's cores."""

from deconf.nets import prepare_torch

prepare_torch()
