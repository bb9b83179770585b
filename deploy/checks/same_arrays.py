"""Whether two .npz files have the same arrays: bit for bit, and transforms in double precision to 1e-12.

    same_arrays.py A.npz B.npz
"""

import sys

import numpy


def is_same(a, b):
    if a.dtype != b.dtype or a.shape != b.shape:
        return False
    return numpy.allclose(a, b, rtol=0.0, atol=1e-12) if a.dtype == "f8" else numpy.array_equal(a, b)


with numpy.load(sys.argv[1]) as first, numpy.load(sys.argv[2]) as second:
    names = sorted(set(first) | set(second))
    different = [name for name in names if name not in first or name not in second or not is_same(first[name], second[name])]
if different:
    sys.exit(f"different: {', '.join(different)}")
print(f"the same: {', '.join(names)}")
