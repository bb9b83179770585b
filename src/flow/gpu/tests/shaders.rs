//! Tests of the shaders that need no GPU.

use core::mem::offset_of;

use naga::valid::{Capabilities, ValidationFlags, Validator};

use crate::flow::gpu::cluster_search::{GROUP, GROUP_BYTES, NORMALS_GROUP, Part};
use crate::flow::gpu::layout;
use crate::flow::gpu::pipelines::{CLUSTER_SOURCE, HALF_SOURCES, NORMALS_SOURCE, SOURCES};
use crate::flow::objects::{ClusterRecord, FoundRecord, SceneRecord, ViewRecord, shared_constants};
use crate::flow::spatial::{IndexRecord, constants_of_planes};

fn parsed(name: &str, source: &str) -> naga::Module {
    naga::front::wgsl::parse_str(source)
        .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(source)))
}

#[test]
fn every_shader_is_valid_and_fits_the_smallest_workgroup_memory() {
    const WORKGROUP_BYTES: u32 = GROUP_BYTES;
    let half = Capabilities::IMMEDIATES
        | Capabilities::SHADER_FLOAT16
        | Capabilities::SUBGROUP
        | Capabilities::COOPERATIVE_MATRIX;
    let single = SOURCES
        .into_iter()
        .chain([NORMALS_SOURCE, CLUSTER_SOURCE])
        .map(|kernel| (kernel, Capabilities::IMMEDIATES));
    let half = HALF_SOURCES
        .as_flattened()
        .iter()
        .map(|&kernel| (kernel, half));
    for ((name, source), capabilities) in single.chain(half) {
        let module = parsed(name, source);
        let mut validator = Validator::new(ValidationFlags::all(), capabilities);
        let info = validator
            .validate(&module)
            .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(source)));
        let mut bytes = 0;
        for (handle, variable) in module.global_variables.iter() {
            if variable.space == naga::AddressSpace::WorkGroup
                && !info.get_entry_point(0)[handle].is_empty()
            {
                bytes += module.types[variable.ty].inner.size(module.to_ctx());
            }
        }
        assert!(bytes <= WORKGROUP_BYTES, "{name}: {bytes}");
        assert_eq!(module.entry_points.len(), 1);
        assert_eq!(module.entry_points[0].name, name);
    }
}

/// The record's fields in the shader: names and offsets, and the record's size.
fn layout(source: &str, record: &str) -> (Vec<(String, usize)>, usize) {
    let module = parsed(record, source);
    let found = module
        .types
        .iter()
        .find(|(_, kind)| kind.name.as_deref() == Some(record));
    let (_, kind) = found.unwrap_or_else(|| panic!("no {record}"));
    let naga::TypeInner::Struct { members, span } = &kind.inner else {
        panic!("{record} is no record")
    };
    let name = |member: &naga::StructMember| member.name.clone().unwrap_or_default();
    let members = members.iter().map(|m| (name(m), m.offset as usize));
    (members.collect(), *span as usize)
}

macro_rules! same_layout {
    ($shader:literal, $record:ident: $($field:ident),+) => {
        let source = SOURCES.iter().find(|(name, _)| *name == $shader).expect("a kernel").1;
        let (fields, size) = layout(source, stringify!($record));
        let ours = vec![$((stringify!($field).to_owned(), offset_of!(layout::$record, $field))),+];
        assert_eq!(fields, ours, stringify!($record));
        assert_eq!(size, size_of::<layout::$record>(), stringify!($record));
    };
}

#[test]
fn host_and_shaders_agree_on_every_record() {
    same_layout!("distance_loss", Transform: origin_high, origin_low, inverse_cell, code_scale, vertices,
        blocks, tables, bricks, codes, far, far_pitch, far_vertices);
    same_layout!("nearest", Cloud: target_points, targets, deformed, nearest, sources);
    same_layout!("distance_loss", Lane: transform, cloud, network, parameters, points, first_tile, tiles, first_chunk, chunks,
        center, scale, margin, margin_slope, truncation, flow_penalty, average, patience, min_delta, steps);
    same_layout!("forward", Step: first, count, weight, step_size, square_correction, ema_weight, share, searches);
    same_layout!("forward", Tile: lane, tile);
    same_layout!("gradients", Chunk: lane, first_row, rows, first_point);
    same_layout!("reduce_loss", Status: state, iterations, best_iteration, best_loss, seen, seen_best,
        without_progress, applies, improves, regularization);
    same_layout!("blend", Grid: vertices, row, plane, channel, variation);
    same_layout!("blend", Placed: cell, weights);
    same_layout!("contract", Axis: stride, extent, count, pitch, begin);
    same_layout!("forward", Part: step, first_tile, first_chunk, tiles, first_row, rows, nothing);
}

macro_rules! same_cluster_layout {
    ($shader_record:literal, $record:ident: $($field:ident),+) => {
        let (fields, size) = layout(CLUSTER_SOURCE.1, $shader_record);
        let ours = vec![$((stringify!($field).to_owned(), offset_of!($record, $field))),+];
        assert_eq!(fields, ours, $shader_record);
        assert_eq!(size, size_of::<$record>(), $shader_record);
    };
}

#[test]
fn host_and_cluster_kernel_agree_on_every_record() {
    same_cluster_layout!("Index", IndexRecord: table, mask, salt, begins, points, count, column_m,
        columns_per_m);
    same_cluster_layout!("View", ViewRecord: free, taken, targets, normals, at, weight);
    same_cluster_layout!("Scene", SceneRecord: source, positions, rows, statics, static_words, voted, views,
        scratch_words, half_bins, bin_m, vote_within_m, cluster_min_points, initial_guesses,
        height_weight, match_m, normal_base_m, normal_slope, tangential_weight, truncation_m, close_fit_m, displacement_penalty, static_fit_m,
        min_motion_m, min_gain_m, max_cost_ratio, min_evidence_m, min_evidence_slope, max_residual_m, min_normal_motion_m,
        neighbor_cost_ratio, neighbor_gain_m, slow_cost_ratio, slow_gain_m);
    same_cluster_layout!("Cluster", ClusterRecord: label, members, count, center_x, center_y);
    same_cluster_layout!("Found", FoundRecord: still_forward, still_backward, is_found, shift_x, shift_y, turn,
        forward, backward, observability, normal_motion, weight, still, moved, nearest_still, nearest_moved,
        forward_still, forward_moved, agree);
    same_cluster_layout!("Part", Part: first, count);
}

#[test]
fn host_and_cluster_kernel_agree_on_every_constant() {
    let source = CLUSTER_SOURCE.1;
    assert_eq!(number(source, "GROUP"), GROUP as f32);
    for (name, value) in shared_constants() {
        assert_eq!(number(source, name), value, "{name}");
    }
    let normals = parsed(NORMALS_SOURCE.0, NORMALS_SOURCE.1);
    let [invocations, ..] = normals.entry_points[0].workgroup_size;
    assert_eq!(invocations as usize, NORMALS_GROUP);
    for (name, value) in constants_of_planes() {
        assert_eq!(number(NORMALS_SOURCE.1, name), value, "{name}");
    }
}

#[test]
fn host_and_brick_kernel_agree_on_every_record() {
    let source = SOURCES[0].1;
    assert_eq!(layout(source, "Plan").1, size_of::<layout::BrickPlan>());
    assert_eq!(layout(source, "Column").1, size_of::<layout::Column>());
}

/// The value of an integer constant of a shader.
fn constant(source: &str, name: &str) -> usize {
    let value = number(source, name);
    assert_eq!(value.fract(), 0.0, "{name}");
    value as usize
}

/// The value of a constant of a shader: a literal, or a quotient of two.
fn number(source: &str, name: &str) -> f32 {
    let line = source
        .lines()
        .find_map(|line| line.strip_prefix(&format!("const {name} = ")));
    let value = line.unwrap_or_else(|| panic!("no {name}"));
    let literals = value.trim_end_matches(';').split(" / ");
    let numbers = literals.map(|literal| literal.trim_end_matches('u').parse::<f32>());
    let numbers = numbers.map(|number| number.unwrap_or_else(|_| panic!("{name} = {value}")));
    numbers.reduce(|a, b| a / b).expect("a value")
}

#[test]
fn host_and_shaders_agree_on_the_network() {
    use crate::flow::field::mlp;
    let source = SOURCES.iter().find(|(name, _)| *name == "forward");
    let source = source.expect("a kernel").1;
    let middle = mlp::middle_layer(0);
    for (name, floats) in [
        ("FIRST_BIAS", mlp::first_layer().bias),
        ("MIDDLE", middle.weights),
        ("MIDDLE_BIAS", middle.bias - middle.weights),
        (
            "MIDDLE_STRIDE",
            mlp::middle_layer(1).weights - middle.weights,
        ),
        ("LAST", mlp::last_layer().weights),
        ("LAST_BIAS", mlp::last_layer().bias),
        ("LAID_OUT", mlp::LAID_OUT),
        ("QUADS", mlp::WIDTH),
    ] {
        assert_eq!(constant(source, name) * 4, floats, "{name}");
    }
    for (name, value) in [
        ("WIDTH", mlp::WIDTH),
        ("MIDDLE_LAYERS", mlp::MIDDLE_LAYERS),
        ("TILE", layout::TILE),
        ("STEPS", layout::STEPS),
        ("ARRAYS", layout::ARRAYS),
    ] {
        assert_eq!(constant(source, name), value, "{name}");
    }
    for [_, forward, _, gradients] in HALF_SOURCES {
        assert_eq!(constant(forward.1, "POINTS") * 2, layout::TILE);
        assert_eq!(constant(forward.1, "LAYER_HALVES"), mlp::WIDTH * mlp::WIDTH);
        assert_eq!(constant(gradients.1, "PANEL"), mlp::PANEL);
    }
}
