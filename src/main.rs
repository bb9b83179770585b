//! The `fnsf` program: parse, dispatch, exit code.

fn main() {}
