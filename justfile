# What a developer runs. `just` lists it; `just test` is the check of every change.

_list:
    @{{just_executable()}} --list --unsorted

# everything that a change must pass: formatting, lints, documentation, all tests
test:
    .ci/test

# as CI: a GPU is required, then the demo, the checks of deploy/ and of the dependencies
ci:
    .ci/run

# formatting and lints
lint:
    cargo fmt --all --check
    PYO3_NO_PYTHON=1 PYO3_BUILD_EXTENSION_MODULE=1 cargo clippy --locked --release --workspace --all-targets -- -D warnings

# the documentation of all items, private ones too
doc:
    RUSTDOCFLAGS="-D warnings" cargo doc --locked --no-deps --document-private-items --open

# unit tests of a module, built quickly: just unit flow::objects
unit module="":
    cargo test --lib {{module}}

# one of cli, formats, layering, numerics, service: just integration service sequences::
integration suite filter="":
    cargo test --test {{suite}} {{filter}}

# one of the benchmarks in benches/
bench name:
    cargo bench --bench {{name}}

# the tables of a page of docs/experiments: just experiment objects
experiment name *arguments:
    cargo bench --bench accuracy -- {{name}} {{arguments}}

# fuzz targets, all or some, so many minutes together: just fuzz 30 pcd queue
fuzz minutes *targets:
    fuzz/run {{minutes}} {{targets}}

# bugs put into a copy of the sources, and which check finds each: just planted no_fence
planted *bugs:
    tests/planted/run {{bugs}}

# a server under load, kills and pauses: just soak 60 --state /tmp/soak
soak minutes *options:
    cargo build --release --locked
    tests/soak/run {{minutes}} {{options}}

# a simulated street through the service, with the picture in demo/
demo:
    cargo run --release -- demo

# the protocol: lints, and no change that breaks clients
proto:
    proto/check

# the Python package: wheel, lints, types, tests
python:
    clients/python/check

# the image's recipe, alerts and dashboard against a release build
deploy-check:
    cargo build --release --locked
    deploy/check --install target/release/fnsf
