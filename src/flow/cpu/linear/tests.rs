//! Tests of the linear model against the dense Kronecker product in double precision.
#![expect(
    clippy::needless_range_loop,
    reason = "vertices are named by index, as in the formulas"
)]

use super::*;
use crate::flow::data::Random;
use crate::flow::options::LinearOptions;

const OPTIONS: LinearOptions = LinearOptions {
    voxel_m: 2.0,
    sigma_m: 5.0,
    variation_weight: 0.5,
    max_bytes: 1 << 30,
};

fn cloud(count: usize) -> Vec<Point> {
    let mut random = Random::new(8);
    let mut axis = |half: f64| random.uniform(-half, half) as f32;
    (0..count)
        .map(|_| [axis(7.0), axis(4.0), axis(1.5)])
        .collect()
}

/// A model over `points`, with random weights.
fn model(isa: Isa, threads: usize, points: &[Point]) -> (Linear, Parameters) {
    let threads = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let grid = LinearGrid::plan(points, &OPTIONS).expect("a small grid");
    let mut parameters = Parameters::zeros(3 * grid.channel());
    grid.initial(&mut Random::new(1), parameters.as_mut_slice());
    let encoder = Encoder::new(isa, Arc::new(threads.expect("threads")), grid);
    let mut model = Linear::new(encoder, OPTIONS.variation_weight);
    model.update(&parameters);
    model.place(points);
    (model, parameters)
}

fn flow(model: &Linear, parameters: &Parameters, points: &[Point]) -> Vec<Point> {
    let mut flow = model.working_set();
    let tiles = points.chunks(TILE).enumerate();
    tiles
        .flat_map(|(tile, points)| {
            let flow = model.forward(parameters, points, tile * TILE, &mut flow);
            flow.to_vec()
        })
        .collect()
}

/// The paper's formulas, one by one: the displacement at a vertex is a sum over all vertices.
struct Dense {
    grid: LinearGrid,
    /// Displacements by axis of the flow and vertex.
    values: Vec<Vec<Vec<Vec<f64>>>>,
}

impl Dense {
    fn new(grid: LinearGrid, parameters: &Parameters) -> Self {
        let [x, y, z] = grid.vertices;
        let sigma = f64::from(grid.sigma_m);
        let encoding = |count: usize| {
            let entry = |i: usize, j: usize| {
                let off = (i as f64 - j as f64) * f64::from(grid.voxel_m);
                (-0.5 * off * off / (sigma * sigma)).exp()
            };
            let rows: Vec<Vec<f64>> = (0..count)
                .map(|i| (0..count).map(|j| entry(i, j)).collect())
                .collect();
            let length = |row: &Vec<f64>| row.iter().map(|e| e * e).sum::<f64>().sqrt();
            let scale = rows.iter().map(length).fold(0.0, f64::max);
            let scaled = |row: Vec<f64>| row.into_iter().map(|e| e / scale).collect();
            rows.into_iter().map(scaled).collect::<Vec<Vec<f64>>>()
        };
        let (phi_x, phi_y, phi_z) = (encoding(x), encoding(y), encoding(z));
        let weight = |channel: usize, i: usize, j: usize, k: usize| {
            let at = channel * grid.channel() + k * grid.plane() + j * grid.row() + i;
            f64::from(parameters.as_slice()[at])
        };
        let value = |channel: usize, a: usize, b: usize, c: usize| {
            let mut sum = 0.0;
            for i in 0..x {
                for j in 0..y {
                    for k in 0..z {
                        let kronecker = phi_x[a][i] * phi_y[b][j] * phi_z[c][k];
                        sum += kronecker * weight(channel, i, j, k);
                    }
                }
            }
            sum
        };
        let along_z = |channel, a, b| (0..z).map(|c| value(channel, a, b, c)).collect();
        let along_y = |channel, a| (0..y).map(|b| along_z(channel, a, b)).collect();
        let along_x = |channel| (0..x).map(|a| along_y(channel, a)).collect();
        Self {
            grid,
            values: (0..3).map(along_x).collect(),
        }
    }

    fn flow(&self, point: Point) -> [f64; 3] {
        let grid = &self.grid;
        let (voxel, sigma) = (f64::from(grid.voxel_m), f64::from(grid.sigma_m));
        let kernel = |off: f64| (-0.25 * off * off / (sigma * sigma)).exp();
        let off = [0, 1, 2].map(|a| (f64::from(point[a]) - f64::from(grid.origin[a])) / voxel);
        let cell = off.map(|at| at.floor() as usize);
        let mut flow = [0.0; 3];
        for corner in 0..8usize {
            let up = [corner & 1, corner >> 1 & 1, corner >> 2];
            let weight: f64 = (0..3)
                .map(|a| {
                    let near = (off[a] - cell[a] as f64) * voxel;
                    let own = if up[a] == 1 { voxel - near } else { near };
                    let across = kernel(voxel);
                    (kernel(own) - kernel(voxel - own) * across) / (1.0 - across * across)
                })
                .product();
            let at = [0, 1, 2].map(|a| cell[a] + up[a]);
            for (channel, flow) in flow.iter_mut().enumerate() {
                *flow += weight * self.values[channel][at[0]][at[1]][at[2]];
            }
        }
        flow
    }

    /// The weighted total variation of the displacements.
    fn variation(&self) -> f64 {
        let [x, y, z] = self.grid.vertices;
        let mut sum = 0.0;
        for values in &self.values {
            for a in 0..x - 1 {
                for b in 0..y - 1 {
                    for c in 0..z - 1 {
                        let own = values[a][b][c];
                        let next = [
                            values[a + 1][b][c],
                            values[a][b + 1][c],
                            values[a][b][c + 1],
                        ];
                        let square: f64 = next.iter().map(|v| (v - own).powi(2)).sum();
                        sum += (1e-5 + square).sqrt();
                    }
                }
            }
        }
        0.5 * sum / ((x - 1) * (y - 1) * (z - 1)) as f64
    }
}

#[test]
fn the_flow_is_that_of_the_dense_kronecker_product() {
    // Rounding of single-precision sums over the vertices of each axis, metres.
    const TOLERANCE_M: f64 = 1e-5;
    let points = cloud(150);
    for isa in Isa::available() {
        let (model, parameters) = model(isa, 2, &points);
        let dense = Dense::new(model.encoder.grid, &parameters);
        for (&point, flow) in points.iter().zip(flow(&model, &parameters, &points)) {
            let expected = dense.flow(point);
            for axis in 0..3 {
                let error = (f64::from(flow[axis]) - expected[axis]).abs();
                assert!(
                    error < TOLERANCE_M,
                    "{isa:?} {point:?}: {flow:?} {expected:?}"
                );
            }
        }
        let error = (f64::from(model.regularization()) - dense.variation()).abs();
        assert!(error < 1e-6, "{isa:?}: {}", model.regularization());
    }
}

#[test]
fn the_gradient_is_the_finite_difference_of_the_dense_formulas() {
    // The loss is a sum of the flows with fixed factors, and the total variation. A step of 1e-3 in
    // double precision leaves the curvature of the variation.
    const STEP: f32 = 1e-3;
    const TOLERANCE: f64 = 1e-4;
    let points = cloud(40);
    let factors = cloud(40);
    for isa in Isa::available() {
        let (mut model, mut parameters) = model(isa, 3, &points);
        flow(&model, &parameters, &points);
        let halves = [factors[..25].to_vec(), factors[25..].to_vec()];
        let mut gradients = parameters.zeros_like();
        model.gradient(&halves, &mut gradients);
        let grid = model.encoder.grid;
        let loss = |parameters: &Parameters| {
            let dense = Dense::new(grid, parameters);
            let sums = points.iter().zip(&factors).map(|(&point, factor)| {
                let flow = dense.flow(point);
                (0..3).map(|a| flow[a] * f64::from(factor[a])).sum::<f64>()
            });
            sums.sum::<f64>() + dense.variation()
        };
        for [channel, z, y, x] in [[0, 0, 0, 0], [0, 1, 2, 5], [1, 2, 3, 1], [2, 3, 5, 8]] {
            let at = channel * grid.channel() + z * grid.plane() + y * grid.row() + x;
            let weight = parameters.as_slice()[at];
            parameters.as_mut_slice()[at] = weight + STEP;
            let ahead = (loss(&parameters), f64::from(parameters.as_slice()[at]));
            parameters.as_mut_slice()[at] = weight - STEP;
            let behind = (loss(&parameters), f64::from(parameters.as_slice()[at]));
            parameters.as_mut_slice()[at] = weight;
            let slope = (ahead.0 - behind.0) / (ahead.1 - behind.1);
            let error = (slope - f64::from(gradients.as_slice()[at])).abs();
            let scale = slope.abs().max(1.0);
            assert!(error < TOLERANCE * scale, "{isa:?} {at}: {slope} {error}");
        }
    }
}

#[test]
fn the_padding_of_the_rows_has_no_gradient_and_no_weight() {
    let points = cloud(30);
    let (mut model, parameters) = model(Isa::available()[0], 1, &points);
    let mut gradients = parameters.zeros_like();
    model.gradient(core::slice::from_ref(&points), &mut gradients);
    let grid = model.encoder.grid;
    assert!(grid.row() > grid.vertices[0]);
    for floats in [parameters.as_slice(), gradients.as_slice()] {
        for row in floats.chunks(grid.row()) {
            assert!(row[grid.vertices[0]..].iter().all(|&float| float == 0.0));
        }
    }
}

#[test]
fn the_field_of_a_result_is_computed_once_and_again_after_it_changes() {
    let points = cloud(50);
    let (mut model, first) = model(Isa::available()[0], 1, &points);
    let sets = WorkingSets::new(&model.encoder.threads, || model.working_set());
    let mut second = first.zeros_like();
    for (to, from) in second.as_mut_slice().iter_mut().zip(first.as_slice()) {
        *to = 2.0 * from;
    }
    for parameters in [&first, &second] {
        model.update(&first);
        let expected = model
            .field(parameters)
            .flow(&points, &model.encoder.threads);
        for _ in 0..2 {
            assert_eq!(model.evaluate(parameters, &points, &sets), expected);
        }
        assert!(model.decoded.get().is_some(), "it is kept");
    }
}

#[test]
fn a_fitted_field_gives_the_flow_of_its_model_and_comes_back_from_its_bytes() {
    let points = cloud(60);
    let (model, parameters) = model(Isa::available()[0], 2, &points);
    let field = model.field(&parameters);
    let threads = &model.encoder.threads;
    assert_eq!(
        field.flow(&points, threads),
        flow(&model, &parameters, &points)
    );
    // Beyond the grid the flow is that of its border.
    let [beyond, border] = [1e6, 1e3].map(|x| field.flow(&[[x, 0.0, 0.0]], threads));
    assert_eq!(beyond, border);
}
