//! The GPU's memory budget. It is allocated once, when the GPU is opened, and divided among the
//! buffers. A linear model and a search of clusters take memory of their own, see gpu/linear.rs and
//! gpu/cluster_search.rs.

use super::adapter::AdapterKind;
use super::layout::{ARRAYS, TILE};
use crate::flow::field::{BackendError, HIDDEN_LAYERS, LAID_OUT, WIDTH};

/// Options for opening a GPU.
#[derive(Clone, Debug)]
pub struct GpuOptions {
    /// Number of lanes: pairs that can be fitted at the same time. Zero counts as one.
    pub lanes: usize,
    /// GPU memory to allocate when the GPU is opened, bytes. An explicit size that cannot be
    /// allocated, or is below the minimum, is refused with [`BackendError::Memory`].
    ///
    /// None stands for 2 GiB plus 256 MiB per lane on a discrete or virtual GPU, 1 GiB on an
    /// integrated one or one of unknown kind, and 320 MiB plus 4 MiB per lane on a software device.
    /// This size is halved until the allocation succeeds. Opening fails with
    /// [`BackendError::Memory`] if the size falls below the minimum.
    pub memory_bytes: Option<u64>,
    /// Threads of the host for the stages that it computes. None stands for the environment variable
    /// `RAYON_NUM_THREADS` if it is set, else for one thread per logical core.
    pub host_threads: Option<usize>,
    /// Threads of the host for each lane, up to which the GPU and not the host finds the normals and
    /// searches the clusters of an object search. All lanes do the same, so that a flow does not depend
    /// on how many are at work. None stands for four, and for zero on a software device.
    pub cluster_threads: Option<usize>,
}

impl GpuOptions {
    /// [`Self::cluster_threads`] on a device of this kind.
    pub(super) fn cluster_threads(&self, kind: AdapterKind) -> usize {
        self.cluster_threads.unwrap_or(match kind {
            AdapterKind::Software => 0,
            // Measured on an H200: half of the time of four threads, and that of eight.
            _ => 4,
        })
    }
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self {
            lanes: 1,
            memory_bytes: None,
            host_threads: None,
            cluster_threads: None,
        }
    }
}

/// Bytes of a row's activations, or of its deltas, for all hidden layers.
const ROW_BYTES: u64 = (HIDDEN_LAYERS * WIDTH * size_of::<f32>()) as u64;
/// Bytes of one network, or of one chunk's gradients.
pub(super) const NETWORK_BYTES: u64 = (LAID_OUT * size_of::<f32>()) as u64;
/// Bytes of a lane's arrays: parameters, transposed weights, Adam's moments and result. The arrays
/// of all lanes share one buffer, so [`super::Adapter::max_binding_bytes`] limits the number of
/// lanes.
pub const LANE_NETWORK_BYTES: u64 = ARRAYS as u64 * NETWORK_BYTES;
/// Minimum number of rows. No chunk has more points.
pub(super) const LEAST_ROWS: u64 = 8192;
/// Maximum number of rows: 8,192 tiles, enough to occupy a large GPU.
const MOST_ROWS: u64 = 1 << 19;
/// Minimum number of chunks: those of a batch of two million points.
const LEAST_CHUNKS: u64 = 256;
/// Bytes of the store per lane: a full sweep's distance transform and points. A sweep with a range
/// of 400 m takes twice as much. With enough memory, at least a quarter of it goes to the store.
const LANE_STORE_BYTES: u64 = 96 << 20;

/// The division of the GPU's memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Budget {
    /// Number of lanes.
    pub(super) lanes: u64,
    /// Rows of activations: points that are processed at the same time.
    pub(super) rows: u64,
    /// Chunks of gradients per submission.
    pub(super) chunks: u64,
    /// Words of the store, for prepared targets and points.
    pub(super) store_words: u64,
}

impl Budget {
    /// Divides `bytes` bytes, where a binding holds at most `binding` bytes.
    ///
    /// # Errors
    /// [`BackendError::Memory`] if the minimum does not fit.
    pub(super) fn new(lanes: usize, bytes: u64, binding: u64) -> Result<Self, BackendError> {
        let lanes = (lanes as u64).min(binding / LANE_NETWORK_BYTES).max(1);
        let networks = lanes * LANE_NETWORK_BYTES;
        let least = networks
            + LANE_STORE_BYTES.min(binding)
            + LEAST_CHUNKS * NETWORK_BYTES
            + LEAST_ROWS * 2 * ROW_BYTES;
        let largest = (LEAST_ROWS * ROW_BYTES).max(LEAST_CHUNKS * NETWORK_BYTES);
        if bytes < least || binding < largest {
            return Err(BackendError::Memory {
                what: "kernels",
                needed: least,
                available: bytes,
            });
        }
        // Memory beyond the minimum goes to the store, then to chunks, then to rows.
        let mut left = bytes - least;
        let mut more = |wished: u64, room: u64| {
            let taken = wished.min(room).min(left);
            left -= taken;
            taken
        };
        let store = LANE_STORE_BYTES.min(binding);
        let wished = (lanes * LANE_STORE_BYTES)
            .max(bytes / 4)
            .saturating_sub(store);
        let store = store + more(wished, binding - store);
        let chunks = LEAST_CHUNKS * NETWORK_BYTES;
        let chunks = chunks + more((lanes - 1) * 16 * NETWORK_BYTES, binding - chunks);
        let rows = LEAST_ROWS * ROW_BYTES;
        let wished = (MOST_ROWS.min(binding / ROW_BYTES) - LEAST_ROWS) * 2 * ROW_BYTES;
        let rows = rows + more(wished, wished) / 2;
        Ok(Self {
            lanes,
            rows: rows / ROW_BYTES / TILE as u64 * TILE as u64,
            chunks: chunks / NETWORK_BYTES,
            store_words: store / 4,
        })
    }

    /// Default number of bytes to allocate.
    pub(super) fn usual(kind: AdapterKind, lanes: usize) -> u64 {
        match kind {
            AdapterKind::Discrete | AdapterKind::Virtual => (2 << 30) + lanes as u64 * (256 << 20),
            AdapterKind::Integrated | AdapterKind::Other => 1 << 30,
            AdapterKind::Software => (320 << 20) + lanes as u64 * (4 << 20),
        }
    }

    pub(super) fn network_bytes(&self) -> u64 {
        self.lanes * LANE_NETWORK_BYTES
    }

    pub(super) fn row_bytes(&self) -> u64 {
        self.rows * ROW_BYTES
    }

    pub(super) fn chunk_bytes(&self) -> u64 {
        self.chunks * NETWORK_BYTES
    }

    /// The sum of all parts, bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.network_bytes() + 2 * self.row_bytes() + self.chunk_bytes() + self.store_words * 4
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_software_device_searches_clusters_only_where_it_is_asked_to() {
        let threads = |cluster_threads, kind| {
            let options = GpuOptions {
                cluster_threads,
                ..GpuOptions::default()
            };
            options.cluster_threads(kind)
        };
        assert_eq!(threads(None, AdapterKind::Software), 0);
        assert_eq!(threads(None, AdapterKind::Discrete), 4);
        assert_eq!(threads(Some(8), AdapterKind::Software), 8);
        assert_eq!(threads(Some(0), AdapterKind::Discrete), 0);
    }

    #[test]
    fn a_small_card_of_its_own_holds_a_sweep_of_400_m() {
        let bytes = Budget::usual(AdapterKind::Discrete, 1);
        let budget = Budget::new(1, bytes, 4 << 30).expect("it fits");
        assert!(budget.store_words * 4 > 200 << 20, "{budget:?}");
    }

    #[test]
    fn a_software_card_has_room_for_a_full_sweep() {
        let bytes = Budget::usual(AdapterKind::Software, 2);
        let budget = Budget::new(2, bytes, 128 << 20).expect("it fits");
        assert!(budget.bytes() <= bytes, "{budget:?}");
        assert!(budget.store_words * 4 >= 80 << 20, "{budget:?}");
        assert!(budget.rows >= LEAST_ROWS && budget.chunks >= LEAST_CHUNKS);
    }

    #[test]
    fn no_binding_is_larger_than_the_card_allows() {
        for (bytes, binding) in [(512 << 20, 128 << 20), (40 << 30, u64::from(u32::MAX))] {
            for lanes in [1, 8, 64] {
                let budget = Budget::new(lanes, bytes, binding).expect("it fits");
                for part in [
                    budget.network_bytes(),
                    budget.row_bytes(),
                    budget.chunk_bytes(),
                    budget.store_words * 4,
                ] {
                    assert!(part <= binding, "{budget:?}");
                }
                assert!(budget.bytes() <= bytes, "{budget:?}");
            }
        }
    }

    #[test]
    fn a_card_that_is_too_small_is_refused_with_what_it_would_take() {
        let refused = Budget::new(1, 64 << 20, 128 << 20).expect_err("too small");
        assert!(matches!(refused, BackendError::Memory { needed, .. } if needed > 64 << 20));
    }
}
