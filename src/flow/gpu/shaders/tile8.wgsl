// Matrix units that multiply 8 x 8 tiles of halves with single-precision sums, such as lavapipe's.
// This file is placed before the half-precision kernels; tile16.wgsl is the alternative.

enable f16;
enable wgpu_cooperative_matrix;

// Rows and columns of a tile.
const SIDE = 8u;
alias Left = coop_mat8x8<f16, A>;
alias Right = coop_mat8x8<f16, B>;
alias Sums = coop_mat8x8<f32, C>;
