"""What processes that are forked for tests share: the command and its kernels."""

import pipelines.cli.commands
import pipelines.cli.serve
import pipelines.scale_out.pools
from saga_fg.kernels.compilation import load_kernels

__all__ = ["pipelines"]

load_kernels()
