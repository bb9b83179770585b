//! Compiles the protobuf definitions, without protoc, if the feature `service` is enabled: the
//! server code for the library and the client code for the tests.

#[cfg(not(feature = "service"))]
fn main() {
    println!("cargo:rerun-if-changed=build.rs");
}

#[cfg(feature = "service")]
fn main() -> Result<(), Box<dyn std::error::Error>> {
    use std::{env, fs, path::PathBuf};

    println!("cargo:rerun-if-changed=proto");
    let mut compiler = protox::Compiler::new(["proto"])?;
    compiler
        .include_imports(true)
        .open_file("fnsf/v1/scene_flow.proto")?;
    let descriptors = compiler.file_descriptor_set();
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(
        out.join("scene_flow.bin"),
        compiler.encode_file_descriptor_set(),
    )?;
    let client = out.join("client");
    fs::create_dir_all(&client)?;
    let builder = || {
        tonic_prost_build::configure()
            .bytes(".")
            .boxed(".fnsf.v1.EstimateFlowRequest.Begin.options")
            .boxed(".fnsf.v1.EstimateSequenceRequest.Begin.options")
            .boxed(".fnsf.v1.SubmitJobRequest.Begin.options")
            .boxed(".fnsf.v1.Options.field")
            .boxed(".fnsf.v1.EstimateSequenceResponse.Pair.outcome.header")
    };
    builder()
        .build_client(false)
        .compile_fds(descriptors.clone())?;
    builder()
        .build_server(false)
        .build_transport(false)
        .out_dir(client)
        .compile_fds(descriptors)?;
    Ok(())
}
