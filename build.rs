//! Compiles the protobuf definitions, without protoc, if the feature `service` is enabled: the
//! server code for the library and the client code for the tests.

use std::env;
use std::error::Error;
use std::fs;
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    if env::var_os("CARGO_FEATURE_SERVICE").is_none() {
        return Ok(());
    }
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
    tonic_prost_build::configure()
        .bytes(".")
        .boxed(".fnsf.v1.EstimateFlowRequest.Begin.options")
        .boxed(".fnsf.v1.EstimateSequenceRequest.Begin.options")
        .boxed(".fnsf.v1.SubmitJobRequest.Begin.options")
        .boxed(".fnsf.v1.Options.field")
        .boxed(".fnsf.v1.EstimateSequenceResponse.Pair.outcome.header")
        .build_client(false)
        .compile_fds(descriptors.clone())?;
    tonic_prost_build::configure()
        .bytes(".")
        .boxed(".fnsf.v1.EstimateFlowRequest.Begin.options")
        .boxed(".fnsf.v1.EstimateSequenceRequest.Begin.options")
        .boxed(".fnsf.v1.SubmitJobRequest.Begin.options")
        .boxed(".fnsf.v1.Options.field")
        .boxed(".fnsf.v1.EstimateSequenceResponse.Pair.outcome.header")
        .build_server(false)
        .build_transport(false)
        .out_dir(client)
        .compile_fds(descriptors)?;
    Ok(())
}
