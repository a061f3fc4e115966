"""The filter in C as exported, called for one spacecraft after the other in place of `SafetyFilter.correct`."""

import ctypes

import numpy as np
import torch
from torch import Tensor

from kernels.build import library
from rta.fast.files import sources
from rta.fast.filter import latency
from rta.filter import SafetyFilter
from rta.result import FilterResult


class InC:
    """Computes `correct` of a filter by the C code from `rta.fast.files`, for batches on a CPU.

    Raises NoCompilerError if no C compiler works.

    Attributes:
        given, found: the structs of safety_filter.h.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        texts = sources(safety_filter, only=("safety_filter.h", "safety_filter.c"))
        head, source = texts["safety_filter.h"], texts["safety_filter.c"]
        found = library({"filter": source.replace('#include "safety_filter.h"\n', head)})
        self.call = found.safety_filter
        self.call.argtypes, self.call.restype = [ctypes.c_void_p, ctypes.c_void_p], None
        self.room, count = latency(safety_filter), len(safety_filter.names)
        sent = ("sent", "f8", (max(1, self.room), 6)), ("sent_count", "i4")
        self.given = np.dtype([("state", "f8", 16), ("desired", "f8", 6), *sent], align=True)
        numbers = [("h", "f8", count), ("slack", "f8", count), ("active", "i4", count)]
        said = [(name, "i4") for name in ("verified", "backup", "violated")]
        self.found = np.dtype([("control", "f8", 6), ("status", "i4"), *said, *numbers], align=True)

    def correct(self, x: Tensor, desired: Tensor, sent: Tensor | None = None) -> FilterResult:
        """Filters as `SafetyFilter.correct`."""
        given, found = (np.zeros(x.shape[1], kind) for kind in (self.given, self.found))
        given["state"], given["desired"] = x.T.numpy(), desired.T.numpy()
        if sent is not None:
            if len(sent) > self.room:
                raise ValueError(f"{len(sent)} controls sent: the C was exported for {self.room}")
            younger = sent.isnan().any(1)  # where the state is younger than a control
            given["sent_count"] = (~younger).sum(0).numpy()
            for column, count in enumerate(given["sent_count"]):
                given["sent"][column, :count] = sent[len(sent) - count :, :, column].numpy()
        at, to = given.ctypes.data, found.ctypes.data
        for i in range(len(given)):
            self.call(at + i * self.given.itemsize, to + i * self.found.itemsize)
        control = torch.from_numpy(found["control"].T.copy())
        verified, backup = (torch.from_numpy(found[name] > 0) for name in ("verified", "backup"))
        h, slack = (torch.from_numpy(found[name].T.copy()) for name in ("h", "slack"))
        return FilterResult(
            control=control,
            intervened=(control != desired).any(0),
            verified=verified,
            backup=backup,
            active=torch.from_numpy(found["active"].T > 0),
            slack=slack,
            status=torch.from_numpy(found["status"].astype(np.int64)),
            h=h,
        )
