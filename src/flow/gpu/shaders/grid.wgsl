// The linear model's grid, shared by its kernels. field/linear.rs has the formulas. A submission
// with a linear model has one lane.

struct Grid {
    // Number of vertices along x, y and z.
    vertices: array<u32, 3>,
    // Floats of a row along x with its padding, of a plane of rows, and of one axis of the flow.
    row: u32,
    plane: u32,
    channel: u32,
    // Weight of the total variation over the number of vertices that it is a mean of.
    variation: f32,
}

// A point on the grid: its voxel's lower vertex, and the weights of the lower and the upper vertex
// along each axis.
struct Placed {
    cell: array<u32, 3>,
    weights: array<f32, 6>,
}
