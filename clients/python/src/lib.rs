//! The native part of the Python package `fnsf`: the estimates of the Rust library on numpy arrays.
//!
//! The functions here take arrays that the Python part has checked for type and shape, and options
//! as the JSON object of the service. They release the interpreter's lock while they compute.

mod arrays;
mod dense;
mod device;
mod errors;
mod estimate;
mod files;
mod objects;
mod scores;
mod sequence;
mod street;
mod supervision;
mod sweeps;

use pyo3::prelude::*;
use pyo3::types::PyBytes;

/// The protocol of the service as a serialized `FileDescriptorSet`.
#[pyfunction]
fn protocol(py: Python<'_>) -> Bound<'_, PyBytes> {
    PyBytes::new(
        py,
        include_bytes!(concat!(env!("OUT_DIR"), "/scene_flow.bin")),
    )
}

/// The module `fnsf._native`.
#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("Error", py.get_type::<errors::Error>())?;
    module.add("InputError", py.get_type::<errors::InputError>())?;
    module.add("DeviceError", py.get_type::<errors::DeviceError>())?;
    module.add_class::<estimate::Motion>()?;
    module.add_class::<sequence::Sequence>()?;
    module.add_class::<street::Street>()?;
    module.add_function(wrap_pyfunction!(protocol, module)?)?;
    module.add_function(wrap_pyfunction!(objects::object_types, module)?)?;
    module.add_function(wrap_pyfunction!(device::device_name, module)?)?;
    module.add_function(wrap_pyfunction!(estimate::estimate, module)?)?;
    module.add_function(wrap_pyfunction!(estimate::check_options, module)?)?;
    module.add_function(wrap_pyfunction!(estimate::keeps_ground, module)?)?;
    module.add_function(wrap_pyfunction!(estimate::pair_interval, module)?)?;
    module.add_function(wrap_pyfunction!(dense::densify, module)?)?;
    module.add_function(wrap_pyfunction!(dense::write_dense, module)?)?;
    module.add_function(wrap_pyfunction!(sweeps::ground, module)?)?;
    module.add_function(wrap_pyfunction!(sweeps::register, module)?)?;
    module.add_function(wrap_pyfunction!(scores::evaluate, module)?)?;
    module.add_function(wrap_pyfunction!(files::read_sweep, module)?)?;
    module.add_function(wrap_pyfunction!(files::read_pair, module)?)?;
    module.add_function(wrap_pyfunction!(files::read_flow, module)?)?;
    module.add_function(wrap_pyfunction!(files::write_flow, module)?)?;
    module.add_function(wrap_pyfunction!(files::draw, module)?)?;
    module.add_function(wrap_pyfunction!(files::write_points, module)?)?;
    Ok(())
}
