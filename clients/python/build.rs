//! Compiles the protocol to a descriptor set, from which the gRPC client builds its messages.

use std::env;
use std::error::Error;
use std::fs;
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=../../proto");
    let mut compiler = protox::Compiler::new(["../../proto"])?;
    compiler
        .include_imports(true)
        .open_file("fnsf/v1/scene_flow.proto")?;
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(
        out.join("scene_flow.bin"),
        compiler.encode_file_descriptor_set(),
    )?;
    Ok(())
}
