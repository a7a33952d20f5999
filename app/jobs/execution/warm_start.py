"""What a calculation needs, loaded and calibrated with once, in the server that the children are forked from.

The fork server imports what it is told to and can be made to do nothing else, so importing this module does the work.
A child is then ready at once, the first and each that takes a killed one's place, and all share one copy in memory.
Where kernels would have to be compiled, which takes minutes in which no child could be started or given up, nothing
happens here and each child warms itself.
"""

from __future__ import annotations

import gc

from app.jobs.execution.child import warm_up
from app.jobs.kinds.registry import JOB_KINDS
from magcal_core.compile_kernels import compiled_mark

if compiled_mark().is_file():
    warm_up(tuple(kind.warm for kind in JOB_KINDS.values() if kind.warm))
    gc.collect()
    gc.freeze()
