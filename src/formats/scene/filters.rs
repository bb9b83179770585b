//! What unfolds the chunks of arrays: deflate, and LZF, which h5py brings along.
//!
//! The library bounds its own deflate by the size of a chunk, unless another filter of the chunk comes
//! before it. Ours are bounded whatever the chunk's filters are.

use std::io::Read;

use flate2::read::ZlibDecoder;
use hdf5_reader::FilterRegistry;
use hdf5_reader::error::Error;
use hdf5_reader::filters::{FILTER_DEFLATE, FILTER_NBIT, FILTER_SCALEOFFSET, FILTER_SZIP};
use hdf5_reader::messages::filter_pipeline::FilterDescription;

use crate::formats::lzf;

/// The number of the filter LZF.
const LZF: u16 = 32000;

/// The filters of a file in which no chunk has more than `limit` bytes.
pub(super) fn filters(limit: usize) -> FilterRegistry {
    let mut filters = FilterRegistry::new();
    let inflate = move |_: &FilterDescription, packed: &[u8], _: usize| inflate(packed, limit);
    filters.register(FILTER_DEFLATE, Box::new(inflate));
    let unfold =
        move |filter: &FilterDescription, packed: &[u8], _: usize| unfold(filter, packed, limit);
    filters.register(LZF, Box::new(unfold));
    for other in [FILTER_SZIP, FILTER_NBIT, FILTER_SCALEOFFSET] {
        let refuse = |filter: &FilterDescription, _: &[u8], _: usize| {
            Err(Error::UnsupportedFilter(format!("filter id {}", filter.id)))
        };
        filters.register(other, Box::new(refuse));
    }
    filters
}

fn inflate(packed: &[u8], limit: usize) -> Result<Vec<u8>, Error> {
    let mut unfolded = Vec::new();
    let mut decoder = ZlibDecoder::new(packed).take(limit as u64 + 1);
    let read = decoder.read_to_end(&mut unfolded);
    read.map_err(|error| Error::DecompressionError(error.to_string()))?;
    if unfolded.len() > limit {
        let text = format!("a chunk unfolds to more than {limit} bytes");
        return Err(Error::ResourceLimit(text));
    }
    Ok(unfolded)
}

/// The chunk by LZF, which declares its size.
fn unfold(filter: &FilterDescription, packed: &[u8], limit: usize) -> Result<Vec<u8>, Error> {
    let declared = filter.client_data.get(2).copied().unwrap_or_default();
    let most = limit.min(packed.len().saturating_mul(lzf::MOST_UNFOLDED));
    let size = usize::try_from(declared).ok().filter(|&size| size <= most);
    let size = size.ok_or_else(|| {
        let packed = packed.len();
        Error::InvalidData(format!("LZF: {packed} bytes declare {declared}"))
    })?;
    lzf::decompress(packed, size).map_err(Error::DecompressionError)
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use flate2::Compression;
    use flate2::write::ZlibEncoder;

    use super::*;

    fn filter(id: u16, client_data: Vec<u32>) -> FilterDescription {
        FilterDescription {
            id,
            name: None,
            client_data,
        }
    }

    #[test]
    fn no_filter_unfolds_to_more_than_the_limit_whatever_comes_before_it() {
        let mut packed = ZlibEncoder::new(Vec::new(), Compression::fast());
        packed.write_all(&[0; 4096]).expect("memory");
        let packed = packed.finish().expect("memory");
        let deflate = filter(FILTER_DEFLATE, vec![]);
        let apply = |limit: usize, filter: &FilterDescription, packed: &[u8]| {
            filters(limit)
                .apply(filter, packed, 4)
                .map(|found| found.len())
        };
        assert_eq!(apply(4096, &deflate, &packed).expect("it fits"), 4096);
        let refused = apply(4095, &deflate, &packed).expect_err("too much");
        assert!(matches!(refused, Error::ResourceLimit(_)), "{refused}");
        // A size that so few bytes cannot have is refused before memory is taken for it.
        let lzf = |size| filter(LZF, vec![4, 0, size]);
        let literal = [0, 7];
        assert_eq!(apply(4096, &lzf(1), &literal).expect("one byte"), 1);
        for size in [0, 177, 1 << 30] {
            assert!(apply(usize::MAX, &lzf(size), &literal).is_err(), "{size}");
        }
        for id in [FILTER_SZIP, FILTER_NBIT, FILTER_SCALEOFFSET] {
            assert!(apply(4096, &filter(id, vec![]), &packed).is_err());
        }
    }
}
