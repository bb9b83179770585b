//! The instruction sets that the kernels are compiled for, and their detection at run time.

/// An instruction set that the kernels are compiled for. Results have the same bits with
/// [`Self::Avx512`] and [`Self::Avx2`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Isa {
    /// AVX-512F: 16 floats per register, with fused multiply-add.
    Avx512,
    /// AVX2 and FMA: 8 floats per register, with fused multiply-add.
    Avx2,
    /// Plain Rust, available on every target. Multiply-adds round the product before the sum.
    Portable,
}

impl Isa {
    /// The instruction sets that this machine supports, fastest first. The last one is always
    /// [`Self::Portable`].
    pub fn available() -> Vec<Self> {
        let mut sets = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            let counts_bits = is_x86_feature_detected!("popcnt");
            if is_x86_feature_detected!("avx512f") && counts_bits {
                sets.push(Self::Avx512);
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") && counts_bits {
                sets.push(Self::Avx2);
            }
        }
        sets.push(Self::Portable);
        sets
    }

    /// The fastest instruction set of this machine.
    pub(in crate::flow) fn fastest() -> Self {
        Self::available()[0]
    }

    /// The name shown in reports and by `fnsf doctor`: `AVX-512`, `AVX2 + FMA` or `portable`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Avx512 => "AVX-512",
            Self::Avx2 => "AVX2 + FMA",
            Self::Portable => "portable",
        }
    }
}
