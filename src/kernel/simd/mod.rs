//! The kernels that every pixel of every frame passes, in vectors.
//!
//! Each is written once over the lanes of `fearless_simd` and compiled for every instruction
//! set (SSE2, SSE4.2, AVX2, AVX-512, NEON); the one that the processor has is taken at start.
//! The `scalar` kernel of the same name is the specification: the same bits, at every level.
#![expect(clippy::inline_always, reason = "only inlined code is compiled for its level")]

pub mod box_filter;
pub mod corners;
pub mod mixture;
pub mod remap;
pub mod semblance;
pub mod steps;
pub mod texture;

/// Run a test at every level that this processor has.
#[cfg(test)]
pub(crate) fn each_level(mut test: impl FnMut(fearless_simd::Level)) {
    use fearless_simd::Level;
    let best = Level::new();
    #[cfg(target_arch = "x86_64")]
    {
        let levels = [
            best.as_sse2().map(Level::Sse2),
            best.as_sse4_2().map(Level::Sse4_2),
            best.as_avx2().map(Level::Avx2),
            best.as_avx512().map(Level::Avx512),
        ];
        levels.into_iter().flatten().for_each(&mut test);
    }
    test(best);
}
