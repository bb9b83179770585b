//! What people write: options of jobs, the server's configuration, manifests and URLs.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;
use std::sync::OnceLock;

use fnsf::config::Config;
use fnsf::job::JobOptions;
use fnsf::label::read_manifest;
use fnsf::remote::Allowed;
use libfuzzer_sys::Corpus;

use crate::targets::forgive_panic;

/// A folder in memory.
pub(crate) const SCRATCH: &str = "/dev/shm";

pub(crate) fn manifest_csv(bytes: &[u8]) -> Corpus {
    if bytes.starts_with(b"PAR1") {
        return Corpus::Reject;
    }
    manifest(bytes);
    Corpus::Keep
}

pub(crate) fn manifest_parquet(bytes: &[u8]) -> Corpus {
    if !bytes.starts_with(b"PAR1") {
        return Corpus::Reject;
    }
    manifest(bytes);
    // The reader of Parquet panics at some damaged files, which the reader of manifests catches.
    forgive_panic();
    Corpus::Keep
}

fn manifest(bytes: &[u8]) {
    let Ok(drives) = read_manifest(bytes.to_vec().into(), Some("/data")) else {
        return;
    };
    for drive in drives {
        let keys: Vec<String> = (0..drive.pairs()).map(|pair| drive.key(pair)).collect();
        assert!(keys.iter().all(|key| !key.is_empty()));
    }
}

pub(crate) fn options(bytes: &[u8]) -> Corpus {
    let Ok(options) = JobOptions::from_json(bytes) else {
        return Corpus::Keep;
    };
    let again = JobOptions::from_json(options.to_json().as_bytes());
    let again = again.expect("what was accepted is accepted again");
    assert!(again == options, "{options:?}");
    for points in [0, 1, 120_000, usize::MAX] {
        let solver = options.solver_options(points);
        assert!(solver.sweeps() >= 2);
    }
    let _refused = (
        options.check_for_pairs(),
        options.check_for_sequence(3),
        options.check_for_poses(),
    );
    let _device = (
        options.device_kind(),
        options.runs_on_gpu(),
        options.chained(),
        options.sweeps(),
    );
    Corpus::Keep
}

pub(crate) fn config(bytes: &[u8]) -> Corpus {
    static FILE: OnceLock<String> = OnceLock::new();
    let path = FILE.get_or_init(|| format!("{SCRATCH}/fnsf-fuzz-{}.toml", std::process::id()));
    let load = |text: &[u8]| {
        let mut file = std::fs::File::create(path).expect("a file");
        file.write_all(text).expect("a file");
        drop(file);
        // No flags: flags are a map.
        Config::load(Some(Path::new(path)), &BTreeMap::<&str, &str>::new())
    };
    if let Ok(config) = load(bytes) {
        let printed = config.to_toml().expect("every configuration has a text");
        // Secrets are not printed.
        if config.api_key.is_none() && config.keys.is_empty() {
            let again = load(printed.as_bytes());
            if let Ok(again) = again {
                assert_eq!(again.to_toml().expect("text"), printed);
            }
        }
    }
    Corpus::Keep
}

pub(crate) fn urls(bytes: &[u8]) -> Corpus {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return Corpus::Reject;
    };
    let prefixes = [
        "https://hooks.example/a/b/".to_owned(),
        "s3://bucket/sweeps/".to_owned(),
    ];
    let allowed = Allowed::new(&prefixes, &["https", "s3"]).expect("good prefixes");
    if let Ok(url) = allowed.check(text) {
        let below = match url.scheme() {
            "https" => url.host_str() == Some("hooks.example") && url.path().starts_with("/a/b/"),
            _ => url.host_str() == Some("bucket") && url.path().starts_with("/sweeps/"),
        };
        let path = url.path().to_ascii_lowercase().replace("%2e", ".");
        let climbs = path.split(['/', '\\']).any(|step| step == "..");
        assert!(
            below && !climbs && url.username().is_empty() && url.password().is_none(),
            "{url}"
        );
        assert!(url.port().is_none(), "{url}");
    }
    let _refused = Allowed::new(&[text.to_owned()], &["https"]);
    Corpus::Keep
}
