//! Tests of the configuration: where values come from, and what is refused.

use super::*;
use std::io::Write;
use std::path::Path;

#[derive(Serialize)]
struct Nothing {}

fn load(text: &str) -> Result<Config, ConfigError> {
    let mut file = tempfile::NamedTempFile::new().expect("a file");
    file.write_all(text.as_bytes()).expect("written");
    Config::load(Some(file.path()), &Nothing {})
}

#[test]
fn what_is_printed_is_read_back() {
    let printed = Config::default().to_toml().expect("TOML");
    let read = load(&printed).expect("a configuration");
    assert_eq!(read.to_toml().expect("TOML"), printed);
}

#[test]
fn unknown_keys_and_wrong_values_are_refused_by_name() {
    for (text, said) in [
        ("lisen = \"127.0.0.1:1\"", "lisen"),
        ("[limits]\nmax_pionts = 1", "max_pionts"),
        ("listen = \"here\"", "listen"),
        ("listen = \"0.0.0.0:8080\"", "listen goes beyond loopback"),
        ("devices = []", "devices is empty"),
        ("gpu_lanes = 0", "gpu_lanes"),
        ("cpu_lanes = 65", "cpu_lanes"),
        ("gpu_memory_mib = 0", "gpu_memory_mib"),
        (
            "[limits]\nmax_upload_mib = 17592186044416",
            "1 to 8796093022208",
        ),
        (
            "[limits]\nmin_free_disk_mib = 17592186044416",
            "min_free_disk_mib",
        ),
        (
            "[limits]\nmax_connections = 9223372036854775807",
            "max_connections",
        ),
        (
            "[limits]\nheader_timeout_seconds = 9223372036854775807",
            "header_timeout",
        ),
        (
            "[limits]\nstream_prefetch_pairs = 9223372036854775807",
            "stream_prefetch_pairs",
        ),
        ("[limits]\nmax_connections = 0", "max_connections"),
        (
            "[shutdown]\ntimeout_seconds = 9223372036854775807",
            "shutdown.timeout",
        ),
        (
            "[shutdown]\nreadiness_delay_seconds = 9223372036854775807",
            "readiness_delay_seconds",
        ),
        ("[queue]\nlease_seconds = 0", "lease_seconds"),
        (
            "[[keys]]\ntenant = \"a\"\nrole = \"root\"\nkey = \"x\"",
            "one of read, write",
        ),
    ] {
        let error = load(text).expect_err(text).to_string();
        assert!(error.contains(said), "{text}: {error}");
    }
    let missing = Config::load(Some(Path::new("/nonexistent")), &Nothing {});
    assert!(missing.is_err());
}

#[test]
fn a_key_that_is_wrong_is_not_shown() {
    for text in [
        "api_key = 12345678901234567890",
        "api_key = 1234567890123456",
        "api_key = 1234567890123.456",
        "api_key = [\"1234567890123456\"]",
        "api_key = \"1234567890123456\" x",
        "api_key = 1234567890123456x",
        "[[keys]]\ntenant = \"a\"\nrole = \"read\"\nkey = 1234567890123456",
        "[[keys]]\ntenant = \"a\"\nrole = \"1234567890123456\"\nkey = \"read\"",
        "keys = \"1234567890123456\"",
        "keys = [\"1234567890123456\"]",
        "tls = \"1234567890123456\"",
    ] {
        let error = load(text).expect_err(text);
        let said = format!("{error} {error:?}");
        assert!(!said.contains("1234567890"), "{text}: {said}");
    }
}

#[test]
fn secrets_are_read_and_never_shown() {
    let config = "api_key = \"a very long secret\"\notlp_endpoint = \"http://a:secret@b:1\"";
    let config = load(config).expect("a configuration");
    let key = config.api_key.clone().expect("a key");
    assert_eq!(key.reveal(), "a very long secret");
    let shown = config.to_toml().expect("TOML");
    let debug = format!("{:?} {:?}", config.api_key, config.keys);
    let shown = format!("{debug}{shown}");
    assert!(
        !shown.contains("secret") && shown.contains("***"),
        "{shown}"
    );
}
