//! Tests of the invariants of ARCHITECTURE.md that the compiler does not check: which module may
//! depend on which, and which features the numerics must not use. They search the text of the
//! source files without comments.

mod circles;
mod dependencies;
mod docs;
mod imports;
mod planted;

use std::fs;
use std::path::{Path, PathBuf};

/// A source file: its path below `src`, its text, and its code without comments and unit tests.
struct Source {
    path: String,
    text: String,
    code: String,
}

fn sources() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    collect(&root, &mut files);
    files.sort();
    let below = |file: &Path| {
        let relative = file.strip_prefix(&root).expect("found below the root");
        relative.to_string_lossy().replace('\\', "/")
    };
    let is_test = |path: &str| {
        path.ends_with("tests.rs") || path.contains("/tests/") || path.contains("/contract")
    };
    let read = |file: &PathBuf| {
        let text = fs::read_to_string(file).expect("a source file is readable");
        let product = text
            .split("#[cfg(test)]\nmod tests {")
            .next()
            .unwrap_or_default();
        let lines = product
            .lines()
            .filter(|line| !line.trim_start().starts_with("//"));
        let path = below(file);
        let code = if is_test(&path) {
            String::new()
        } else {
            lines.collect::<Vec<_>>().join("\n")
        };
        Source { path, code, text }
    };
    files.iter().map(read).collect()
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).expect("a folder is readable") {
        let path = entry.expect("an entry is readable").path();
        if path.is_dir() {
            collect(&path, files);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
}

/// Every line of the files under `room` that contains one of `words`.
fn uses(room: &str, words: &[&str]) -> Vec<String> {
    let mut found = Vec::new();
    assert!(
        sources().iter().any(|source| source.path.starts_with(room)),
        "no file lies under {room}"
    );
    for source in sources()
        .iter()
        .filter(|source| source.path.starts_with(room))
    {
        for line in source.code.lines() {
            if words.iter().any(|word| line.contains(word)) {
                found.push(format!("{}: {}", source.path, line.trim()));
            }
        }
    }
    found
}

/// Lines that contain one of `words`, in files under `room` whose path does not start with `home`.
fn uses_outside(room: &str, home: &str, words: &[&str]) -> Vec<String> {
    let mut users = uses(room, words);
    users.retain(|line| !line.starts_with(home));
    users
}

#[test]
fn the_numerics_know_nothing_of_the_rest() {
    let outside = sources()
        .iter()
        .filter(|source| source.path.starts_with("flow/"))
        .flat_map(|source| {
            let foreign = |line: &&str| line.contains("crate::") && !line.contains("crate::flow");
            let lines: Vec<_> = source
                .code
                .lines()
                .filter(foreign)
                .map(str::to_owned)
                .collect();
            lines
        })
        .collect::<Vec<_>>();
    assert_eq!(outside, [""; 0]);
}

#[test]
fn the_numerics_have_no_clock_no_files_no_environment_no_async_and_print_nothing() {
    let forbidden = [
        "std::time",
        "std::fs",
        "std::env",
        "std::io",
        "std::net",
        "std::process",
        "Instant",
        "async ",
        ".await",
        "tokio",
        "println!",
        "thread_local!",
    ];
    assert_eq!(uses("flow/", &forbidden), [""; 0]);
    // Only `static` items count as globals. `'static` lifetimes also match the search.
    let mut globals = uses("flow/", &["static "]);
    globals.retain(|line| {
        let code = line.split_once(": ").map_or("", |(_, code)| code.trim());
        code.split(' ').find(|word| !word.starts_with("pub")) == Some("static")
    });
    assert_eq!(globals, [""; 0]);
}

#[test]
fn the_solver_sees_only_the_backends_traits() {
    assert_eq!(
        uses(
            "flow/estimate/run.rs",
            &["cpu::", "gpu::", "distance::", "mlp"]
        ),
        [""; 0]
    );
}

#[test]
fn nothing_but_the_cpu_backend_sees_the_cpu_backend() {
    assert_eq!(uses_outside("flow/", "flow/cpu/", &["cpu::"]), [""; 0]);
}

#[test]
fn backends_never_see_each_other_and_no_type_of_wgpu_leaves_its_room() {
    assert_eq!(uses("flow/cpu/", &["gpu::", "wgpu"]), [""; 0]);
    assert_eq!(uses("flow/gpu/", &["cpu::", "CpuBackend"]), [""; 0]);
    assert_eq!(uses_outside("", "flow/gpu/", &["wgpu"]), [""; 0]);
    // Only the code that opens a device names the GPU module. All other code uses the backends'
    // traits.
    let choose = [
        "app/devices.rs",
        "cli/device.rs",
        "cli/doctor/",
        "engine/mod.rs: pub(crate) use test_gpu",
    ];
    let mut users = uses_outside("", "flow/", &["flow::gpu", "gpu::"]);
    users.retain(|line| !choose.iter().any(|room| line.starts_with(room)));
    assert_eq!(users, [""; 0]);
}

#[test]
fn formats_and_pictures_know_no_solver_and_no_command_line() {
    let forbidden = [
        "crate::cli",
        "flow::cpu",
        "flow::estimate",
        "flow::backend",
        "clap",
    ];
    assert_eq!(uses("formats/", &forbidden), [""; 0]);
    assert_eq!(uses("picture/", &forbidden), [""; 0]);
    assert_eq!(uses("picture/", &["crate::formats"]), [""; 0]);
}

#[test]
fn the_queue_moves_jobs_and_never_looks_inside_a_payload() {
    let forbidden = [
        "crate::payload",
        "crate::storage",
        "crate::engine",
        "crate::flow",
        "crate::api",
        "crate::worker",
        "JobOptions",
    ];
    assert_eq!(uses("queue/", &forbidden), [""; 0]);
}

#[test]
fn only_the_worker_sees_both_the_queue_and_the_engine() {
    let sees_the_queue = uses_outside("", "queue/", &["crate::queue"]);
    let sees_the_engine = uses_outside("", "engine", &["crate::engine"]);
    let file = |line: &String| line.split(':').next().unwrap_or_default().to_owned();
    let both: std::collections::BTreeSet<String> = sees_the_queue
        .iter()
        .map(file)
        .filter(|name| sees_the_engine.iter().any(|line| file(line) == *name))
        .collect();
    // `app` builds the parts, and the admin port reports the state of both.
    let known = [
        "api/admin.rs",
        "app/housekeeping.rs",
        "app/start.rs",
        "worker/densify.rs",
        "worker/load.rs",
        "worker/run.rs",
    ];
    assert_eq!(both.iter().map(String::as_str).collect::<Vec<_>>(), known);
    assert_eq!(
        uses("engine", &["crate::queue", "crate::storage", "crate::api"]),
        [""; 0]
    );
}

#[test]
fn each_protocol_has_one_room() {
    let http = uses_outside("api/", "api/http/", &["axum::"]);
    let ports = [
        "api/admin.rs",
        "api/middleware.rs",
        "api/listener",
        "api/routes.rs",
        "api/origin.rs",
        "api/grpc/",
    ];
    let stray: Vec<_> = http
        .iter()
        .filter(|line| !ports.iter().any(|port| line.starts_with(port)))
        .collect();
    assert_eq!(stray, [""; 0]);
    assert_eq!(
        uses_outside("", "api/grpc/", &["prost", "proto::"]),
        [""; 0]
    );
    assert_eq!(uses_outside("", "queue/sqlite/", &["rusqlite"]), [""; 0]);
    let outside = uses_outside(
        "",
        "queue/postgres/",
        &["postgres::Client", "tokio_postgres"],
    );
    assert_eq!(outside, [""; 0]);
    assert_eq!(uses_outside("", "storage/", &["object_store"]), [""; 0]);
}

#[test]
fn metrics_have_their_names_and_errors_their_status_in_one_place() {
    assert_eq!(uses_outside("", "metrics", &["prometheus_client"]), [""; 0]);
    let mut named = uses_outside("api/", "api/http/", &["StatusCode::"]);
    // The admin port has one status of its own: not ready.
    named.retain(|line| !line.starts_with("api/admin.rs"));
    assert_eq!(named, [""; 0]);
    assert_eq!(
        uses(
            "api/http/",
            &["StatusCode::BAD_REQUEST", "StatusCode::NOT_FOUND"]
        ),
        [""; 0]
    );
}

#[test]
fn only_the_command_line_prints() {
    let printing = ["println!", "eprintln!", "print!("];
    assert_eq!(uses_outside("", "cli/", &printing), [""; 0]);
    // One function makes text of others harmless for a terminal.
    assert_eq!(
        uses_outside("cli/", "cli/output.rs", &["eprintln!"]),
        [""; 0]
    );
}

#[test]
fn unsafe_code_stays_in_the_vector_kernels_but_for_two_words_to_the_driver() {
    let mut users = uses_outside("", "flow/cpu/", &["unsafe "]);
    let kernels = [
        "flow/simd/lanes.rs",
        "flow/spatial/column_kernels.rs",
        "flow/spatial/neighborhood.rs",
    ];
    users.retain(|line| !kernels.iter().any(|file| line.starts_with(file)));
    let to_the_driver = [
        "flow/gpu/matrix_units.rs: let experiments = ",
        "flow/gpu/pipelines.rs: unsafe { device.create_shader_module_trusted",
    ];
    users.retain(|line| !to_the_driver.iter().any(|word| line.starts_with(word)));
    assert_eq!(users, [""; 0]);
}

#[test]
fn hyper_parameters_are_written_in_the_options_alone() {
    let names = ["learning_rate:", "flow_penalty:", "margin_m:", "patience:"];
    let mut users = uses_outside("", "flow/options/", &names);
    users.retain(|line| {
        let value = line.rsplit(": ").next().unwrap_or_default();
        !line.contains("fn ") && value.starts_with(|c: char| c.is_ascii_digit())
    });
    assert_eq!(users, [""; 0]);
}

#[test]
fn every_file_says_what_it_is_and_stays_short() {
    for source in sources() {
        assert!(
            source.text.starts_with("//! "),
            "{} does not say what it is",
            source.path
        );
        let lines = source.text.lines().count();
        assert!(lines <= 500, "{} has {lines} lines", source.path);
    }
}
