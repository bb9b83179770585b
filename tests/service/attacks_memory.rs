//! Attacks by files that take more memory to decode than they have bytes or points.

use fnsf::formats::CloudFormat;

use crate::attacks_files::post;
use crate::clouds::{file, small_pair};
use crate::server::Server;

/// A compressed PCD of 3,000 points whose body is 180 MB once it is decompressed.
fn padded_lzf() -> Vec<u8> {
    let unfolded = 3000 * (12 + 60_000_u32);
    let mut packed = vec![0, 7];
    let mut left = unfolded - 1;
    while left > 0 {
        let copied = left.min(264);
        // Nine or more are copied by a long reference; a rest is written as it is.
        if copied >= 9 {
            packed.extend([0xe0, u8::try_from(copied - 9).expect("a byte"), 0]);
        } else {
            packed.push(u8::try_from(copied - 1).expect("a byte"));
            packed.extend(vec![0; copied as usize]);
        }
        left -= copied;
    }
    let mut bytes =
        b"VERSION .7\nFIELDS x y z pad\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 60000\n\
        WIDTH 3000\nHEIGHT 1\nPOINTS 3000\nDATA binary_compressed\n"
            .to_vec();
    bytes.extend(u32::try_from(packed.len()).expect("small").to_le_bytes());
    bytes.extend(unfolded.to_le_bytes());
    bytes.extend(packed);
    // As long as a body of this size has to be.
    bytes.resize(6_000_000, 0);
    bytes
}

#[tokio::test]
async fn the_body_of_a_compressed_cloud_is_part_of_the_upload_budget() {
    let server = Server::with_config("[limits]\nmax_upload_mib = 64\nmax_total_upload_mib = 128\n");
    let (bomb, good) = (padded_lzf(), file(CloudFormat::Npy, &small_pair()[0]));
    let problem = post(&server, [&good, &bomb], "default")
        .await
        .expect_err("180 MB are not there");
    assert_eq!(problem["code"], "too_large", "{problem}");
    // Where the memory is there, the file is read.
    let server = Server::with_config("[limits]\nmax_upload_mib = 64\nmax_total_upload_mib = 512\n");
    if let Err(problem) = post(&server, [&good, &bomb], "default").await {
        let code = &problem["code"];
        assert!(code != "server_full" && code != "too_large", "{problem}");
    }
}
