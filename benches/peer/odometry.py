"""The ego motion of a pair by KISS-ICP, for the benchmarks that need it.

Its threads are those of TBB and OpenMP: set `OMP_NUM_THREADS` before this module is imported.
"""

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP


def by_kiss_icp(source: np.ndarray, target: np.ndarray, threads: int) -> np.ndarray:
    """target_from_source, by the defaults: the odometry from the target as first sweep to the source as second."""
    config = KISSConfig()
    config.registration.max_num_threads = threads
    config.mapping.voxel_size = config.data.max_range / 100.0
    config.data.deskew = False
    odometry = KissICP(config)
    for sweep in (target, source):
        odometry.register_frame(sweep, np.zeros(len(sweep)))
    return odometry.last_pose
