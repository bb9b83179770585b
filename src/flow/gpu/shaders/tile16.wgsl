// Matrix units that multiply 16 x 16 tiles of halves with single-precision sums, such as NVIDIA's.
// This file is placed before the half-precision kernels; tile8.wgsl is the alternative.

enable f16;
enable wgpu_cooperative_matrix;

// Rows and columns of a tile.
const SIDE = 16u;
alias Left = coop_mat16x16<f16, A>;
alias Right = coop_mat16x16<f16, B>;
alias Sums = coop_mat16x16<f32, C>;
