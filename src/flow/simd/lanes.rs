//! Vector registers: the operations of the kernels on AVX-512, AVX2 + FMA and plain arrays.
//!
//! One trait, so that every kernel is written once. Every operation is inlined into a caller for
//! which the instruction set is enabled.
#![expect(
    unsafe_code,
    reason = "vector intrinsics and unchecked loads are the point of this file"
)]

/// One vector register of `COUNT` floats.
///
/// # Safety
///
/// `COUNT` is the number of floats that `load` reads and `store` writes. Every function requires
/// the CPU features of the implementation; `load` and `store` require `COUNT` valid floats at the
/// pointer.
pub(in crate::flow) unsafe trait Lanes: Copy {
    /// Floats in one register.
    const COUNT: usize;
    unsafe fn splat(value: f32) -> Self;
    unsafe fn load(from: *const f32) -> Self;
    unsafe fn store(self, to: *mut f32);
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn sub(self, other: Self) -> Self;
    /// `self` where it is less than `other`, else `other`.
    unsafe fn min(self, other: Self) -> Self;
    /// `self` where `a < b`, else `other`.
    unsafe fn where_less(self, a: Self, b: Self, other: Self) -> Self;
    /// `self * factor + addend`; fused on AVX-512 and AVX2 + FMA, rounded twice in plain Rust.
    unsafe fn mul_add(self, factor: Self, addend: Self) -> Self;
    /// `max(self, 0)`.
    unsafe fn relu(self) -> Self;
    /// `self` where `gate > 0`, else 0.
    unsafe fn where_positive(self, gate: Self) -> Self;
    unsafe fn mul(self, other: Self) -> Self;
    /// `self` where `a == b`, else `other`.
    unsafe fn where_equal(self, a: Self, b: Self, other: Self) -> Self;
    /// One bit a float, the first one lowest: whether it is less than that of `other`.
    unsafe fn less(self, other: Self) -> u32;
    /// The minimum of the floats. No float may be NaN.
    unsafe fn least(self) -> f32;
    /// `sums` with the products of the floats added in double precision. A product goes to the sum
    /// of its place modulo four.
    unsafe fn add_products(self, other: Self, sums: [f64; 4]) -> [f64; 4];
}

#[cfg(target_arch = "x86_64")]
pub(in crate::flow) use x86::{F32x8, F32x16};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use crate::flow::simd::lanes::Lanes;
    use core::arch::x86_64::*;

    /// An AVX-512 register of 16 floats.
    #[derive(Clone, Copy)]
    pub(in crate::flow) struct F32x16(__m512);

    // SAFETY: 16 floats fill the register.
    unsafe impl Lanes for F32x16 {
        const COUNT: usize = 16;

        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            // SAFETY: the caller has avx512f.
            Self(unsafe { _mm512_set1_ps(value) })
        }
        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self {
            // SAFETY: the caller has avx512f and gives 16 valid floats.
            Self(unsafe { _mm512_loadu_ps(from) })
        }
        #[inline(always)]
        unsafe fn store(self, to: *mut f32) {
            // SAFETY: the caller has avx512f and gives room for 16 floats.
            unsafe { _mm512_storeu_ps(to, self.0) }
        }
        #[inline(always)]
        unsafe fn add(self, other: Self) -> Self {
            // SAFETY: the caller has avx512f.
            Self(unsafe { _mm512_add_ps(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn sub(self, other: Self) -> Self {
            // SAFETY: the caller has avx512f.
            Self(unsafe { _mm512_sub_ps(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn min(self, other: Self) -> Self {
            // SAFETY: the caller has avx512f.
            Self(unsafe { _mm512_min_ps(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn where_less(self, a: Self, b: Self, other: Self) -> Self {
            // SAFETY: the caller has avx512f.
            unsafe {
                let mask = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a.0, b.0);
                Self(_mm512_mask_mov_ps(other.0, mask, self.0))
            }
        }
        #[inline(always)]
        unsafe fn mul_add(self, factor: Self, addend: Self) -> Self {
            // SAFETY: the caller has avx512f.
            Self(unsafe { _mm512_fmadd_ps(self.0, factor.0, addend.0) })
        }
        #[inline(always)]
        unsafe fn relu(self) -> Self {
            // SAFETY: the caller has avx512f.
            Self(unsafe { _mm512_max_ps(self.0, _mm512_setzero_ps()) })
        }
        #[inline(always)]
        unsafe fn where_positive(self, gate: Self) -> Self {
            // SAFETY: the caller has avx512f.
            unsafe {
                let mask = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(gate.0, _mm512_setzero_ps());
                Self(_mm512_maskz_mov_ps(mask, self.0))
            }
        }
        #[inline(always)]
        unsafe fn mul(self, other: Self) -> Self {
            // SAFETY: the caller has avx512f.
            Self(unsafe { _mm512_mul_ps(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn where_equal(self, a: Self, b: Self, other: Self) -> Self {
            // SAFETY: the caller has avx512f.
            unsafe {
                let mask = _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(a.0, b.0);
                Self(_mm512_mask_mov_ps(other.0, mask, self.0))
            }
        }
        #[inline(always)]
        unsafe fn less(self, other: Self) -> u32 {
            // SAFETY: the caller has avx512f.
            u32::from(unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn least(self) -> f32 {
            // SAFETY: the caller has avx512f.
            unsafe { _mm512_reduce_min_ps(self.0) }
        }
        #[inline(always)]
        unsafe fn add_products(self, other: Self, sums: [f64; 4]) -> [f64; 4] {
            // SAFETY: the caller has avx512f.
            unsafe {
                let [a, b] = [self.0, other.0];
                let sums = added(
                    _mm512_extractf32x4_ps::<0>(a),
                    _mm512_extractf32x4_ps::<0>(b),
                    sums,
                );
                let sums = added(
                    _mm512_extractf32x4_ps::<1>(a),
                    _mm512_extractf32x4_ps::<1>(b),
                    sums,
                );
                let sums = added(
                    _mm512_extractf32x4_ps::<2>(a),
                    _mm512_extractf32x4_ps::<2>(b),
                    sums,
                );
                added(
                    _mm512_extractf32x4_ps::<3>(a),
                    _mm512_extractf32x4_ps::<3>(b),
                    sums,
                )
            }
        }
    }

    /// `sums` with the products of four floats added in double precision.
    ///
    /// # Safety
    /// The caller has avx.
    #[inline(always)]
    unsafe fn added(a: __m128, b: __m128, sums: [f64; 4]) -> [f64; 4] {
        let mut added = [0.0; 4];
        // SAFETY: the caller has avx, and the arrays have 4 doubles.
        unsafe {
            let products = _mm256_mul_pd(_mm256_cvtps_pd(a), _mm256_cvtps_pd(b));
            let sums = _mm256_add_pd(_mm256_loadu_pd(sums.as_ptr()), products);
            _mm256_storeu_pd(added.as_mut_ptr(), sums);
        }
        added
    }

    /// An AVX register of 8 floats, with FMA.
    #[derive(Clone, Copy)]
    pub(in crate::flow) struct F32x8(__m256);

    // SAFETY: 8 floats fill the register.
    unsafe impl Lanes for F32x8 {
        const COUNT: usize = 8;

        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            // SAFETY: the caller has avx2.
            Self(unsafe { _mm256_set1_ps(value) })
        }
        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self {
            // SAFETY: the caller has avx2 and gives 8 valid floats.
            Self(unsafe { _mm256_loadu_ps(from) })
        }
        #[inline(always)]
        unsafe fn store(self, to: *mut f32) {
            // SAFETY: the caller has avx2 and gives room for 8 floats.
            unsafe { _mm256_storeu_ps(to, self.0) }
        }
        #[inline(always)]
        unsafe fn add(self, other: Self) -> Self {
            // SAFETY: the caller has avx2.
            Self(unsafe { _mm256_add_ps(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn sub(self, other: Self) -> Self {
            // SAFETY: the caller has avx2.
            Self(unsafe { _mm256_sub_ps(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn min(self, other: Self) -> Self {
            // SAFETY: the caller has avx2.
            Self(unsafe { _mm256_min_ps(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn where_less(self, a: Self, b: Self, other: Self) -> Self {
            // SAFETY: the caller has avx2.
            unsafe {
                let mask = _mm256_cmp_ps::<_CMP_LT_OQ>(a.0, b.0);
                Self(_mm256_blendv_ps(other.0, self.0, mask))
            }
        }
        #[inline(always)]
        unsafe fn mul_add(self, factor: Self, addend: Self) -> Self {
            // SAFETY: the caller has fma.
            Self(unsafe { _mm256_fmadd_ps(self.0, factor.0, addend.0) })
        }
        #[inline(always)]
        unsafe fn relu(self) -> Self {
            // SAFETY: the caller has avx2.
            Self(unsafe { _mm256_max_ps(self.0, _mm256_setzero_ps()) })
        }
        #[inline(always)]
        unsafe fn where_positive(self, gate: Self) -> Self {
            // SAFETY: the caller has avx2.
            unsafe {
                let mask = _mm256_cmp_ps::<_CMP_GT_OQ>(gate.0, _mm256_setzero_ps());
                Self(_mm256_and_ps(mask, self.0))
            }
        }
        #[inline(always)]
        unsafe fn mul(self, other: Self) -> Self {
            // SAFETY: the caller has avx2.
            Self(unsafe { _mm256_mul_ps(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn where_equal(self, a: Self, b: Self, other: Self) -> Self {
            // SAFETY: the caller has avx2.
            unsafe {
                let mask = _mm256_cmp_ps::<_CMP_EQ_OQ>(a.0, b.0);
                Self(_mm256_blendv_ps(other.0, self.0, mask))
            }
        }
        #[inline(always)]
        unsafe fn less(self, other: Self) -> u32 {
            // SAFETY: the caller has avx2.
            let mask = unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)) };
            mask.cast_unsigned()
        }
        #[inline(always)]
        unsafe fn least(self) -> f32 {
            // SAFETY: the caller has avx2.
            unsafe {
                let four = _mm_min_ps(
                    _mm256_castps256_ps128(self.0),
                    _mm256_extractf128_ps::<1>(self.0),
                );
                let two = _mm_min_ps(four, _mm_movehl_ps(four, four));
                let one = _mm_min_ss(two, _mm_shuffle_ps::<1>(two, two));
                _mm_cvtss_f32(one)
            }
        }
        #[inline(always)]
        unsafe fn add_products(self, other: Self, sums: [f64; 4]) -> [f64; 4] {
            // SAFETY: the caller has avx2.
            unsafe {
                let [a, b] = [self.0, other.0];
                let [low_a, low_b] = [_mm256_castps256_ps128(a), _mm256_castps256_ps128(b)];
                let sums = added(low_a, low_b, sums);
                added(
                    _mm256_extractf128_ps::<1>(a),
                    _mm256_extractf128_ps::<1>(b),
                    sums,
                )
            }
        }
    }
}

/// Four floats in plain Rust, which most targets compile to one register.
#[derive(Clone, Copy)]
pub(in crate::flow) struct F32x4([f32; 4]);

// SAFETY: the array has 4 floats.
unsafe impl Lanes for F32x4 {
    const COUNT: usize = 4;

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        Self([value; 4])
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller gives 4 valid floats; the array has their alignment.
        Self(unsafe { from.cast::<[f32; 4]>().read() })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller gives room for 4 floats; the array has their alignment.
        unsafe { to.cast::<[f32; 4]>().write(self.0) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        Self(core::array::from_fn(|i| self.0[i] + other.0[i]))
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        Self(core::array::from_fn(|i| self.0[i] - other.0[i]))
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        // SAFETY: as for this function.
        unsafe { self.where_less(self, other, other) }
    }
    #[inline(always)]
    unsafe fn where_less(self, a: Self, b: Self, other: Self) -> Self {
        Self(core::array::from_fn(|i| {
            if a.0[i] < b.0[i] {
                self.0[i]
            } else {
                other.0[i]
            }
        }))
    }
    #[inline(always)]
    unsafe fn mul_add(self, factor: Self, addend: Self) -> Self {
        Self(core::array::from_fn(|i| {
            self.0[i] * factor.0[i] + addend.0[i]
        }))
    }
    #[inline(always)]
    unsafe fn relu(self) -> Self {
        Self(self.0.map(|x| if x > 0.0 { x } else { 0.0 }))
    }
    #[inline(always)]
    unsafe fn where_positive(self, gate: Self) -> Self {
        Self(core::array::from_fn(|i| {
            if gate.0[i] > 0.0 { self.0[i] } else { 0.0 }
        }))
    }
    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        Self(core::array::from_fn(|i| self.0[i] * other.0[i]))
    }
    #[inline(always)]
    unsafe fn where_equal(self, a: Self, b: Self, other: Self) -> Self {
        Self(core::array::from_fn(|i| {
            if a.0[i] == b.0[i] {
                self.0[i]
            } else {
                other.0[i]
            }
        }))
    }
    #[inline(always)]
    unsafe fn less(self, other: Self) -> u32 {
        (0..4).fold(0, |bits, i| bits | u32::from(self.0[i] < other.0[i]) << i)
    }
    #[inline(always)]
    unsafe fn least(self) -> f32 {
        self.0.into_iter().fold(f32::INFINITY, f32::min)
    }
    #[inline(always)]
    unsafe fn add_products(self, other: Self, sums: [f64; 4]) -> [f64; 4] {
        core::array::from_fn(|i| sums[i] + f64::from(self.0[i]) * f64::from(other.0[i]))
    }
}
