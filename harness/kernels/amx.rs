//! Matrix products of f32 matrices on the tile unit of newer x86 processors (Intel AMX).
//!
//! The unit multiplies bf16 tiles and sums in f32, many times as fast as the vector units. An f32 has 24 significant
//! bits and a bf16 has 8. So an f32 is split exactly into three bf16 parts of decreasing size: `a = a0 + a1 + a2`. Of
//! the nine products of parts, the six with `i + j <= 2` are computed. The other three sum to less than 2^-23 of
//! `|a| |b|`, which is the size of an f32's own rounding error. The idea is from Henry, Tang and Heinecke, "Leveraging
//! the bfloat16 artificial intelligence datatype for higher-precision computations", 2019. A single rounded part gives
//! a bf16 product.
//!
//! Every element of the destination is summed in the same order for any number of threads.

use crate::matrix::{Accumulate, Matrix};
use rayon::prelude::*;
use std::arch::asm;
use std::arch::x86_64::*;
use std::cell::RefCell;
use std::marker::PhantomData;
use std::sync::OnceLock;

/// Number of lines (rows of the left matrix, columns of the right one) that one call of the kernel processes on each
/// side.
const STRIP: usize = 2 * TILE;
/// Number of lines of a tile.
const TILE: usize = 16;
/// Number of terms of the inner sum in one tile.
const STEP: usize = 32;
/// Most lines of the packed side that all strips of the other side are multiplied with.
const PACKED_LINES: usize = 1024;
/// Most bytes of the packed side: most of a core's second-level cache.
const PACKED_BYTES: usize = 3 << 19;

/// Whether this processor has the tile unit, and the operating system lets this process use it.
pub fn available() -> bool {
    static AVAILABLE: OnceLock<bool> = OnceLock::new();
    *AVAILABLE.get_or_init(|| {
        const TILES: u32 = 1 << 24;
        const BF16: u32 = 1 << 22;
        let has_tiles = __cpuid(0).eax >= 7 && __cpuid_count(7, 0).edx & (TILES | BF16) == TILES | BF16;
        let has_vectors = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512bf16");
        has_tiles && has_vectors && allowed_by_linux()
    })
}

/// Asks Linux for permission to use the tile registers (arch/x86/include/uapi/asm/prctl.h). The permission holds for
/// all threads.
#[cfg(target_os = "linux")]
fn allowed_by_linux() -> bool {
    const ARCH_REQ_XCOMP_PERM: libc::c_int = 0x1023;
    const XFEATURE_XTILEDATA: libc::c_int = 18;
    // SAFETY: this system call takes two numbers and does not access the process's memory.
    unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) == 0 }
}

#[cfg(not(target_os = "linux"))]
fn allowed_by_linux() -> bool {
    false
}

/// Computes `out = a b`, or `out += a b`, with `PARTS` bf16 parts for each value (1 or 3), on `threads` threads. Panics
/// unless [`available`].
pub fn product<const PARTS: usize>(a: Matrix, b: Matrix, out: &mut [f32], into: Accumulate, threads: usize) {
    const { assert!(PARTS == 1 || PARTS == 3) };
    assert!(available(), "this processor has no tile unit, or may not use it");
    let ((m, depth), (rows, n)) = (a.shape(), b.shape());
    assert_eq!(depth, rows, "the depth of a {m} x {depth} matrix times a {rows} x {n} one");
    assert_eq!(out.len(), m * n, "the length of a {m} x {n} product");
    if m == 0 || n == 0 {
        return;
    }
    if depth == 0 {
        if into == Accumulate::Overwrite {
            out.fill(0.0);
        }
        return;
    }
    let (left, right) = (Operand::left(a), Operand::right(b));
    let destination = Destination { first: out.as_mut_ptr(), m, n };
    let strips = m.max(n).div_ceil(STRIP);
    let share = strips.div_ceil(threads.max(1));
    let work = |thread: usize| {
        let strips = (thread * share).min(strips)..((thread + 1) * share).min(strips);
        // SAFETY: `available` was checked, and each thread writes only to its own strips.
        unsafe { multiply_strips::<PARTS>(left, right, strips, destination, into) }
    };
    if threads <= 1 || strips == 1 {
        work(0);
        return;
    }
    (0..threads).into_par_iter().for_each(work);
}

/// One side of a product: `lines` lines with `depth` values each.
#[derive(Clone, Copy)]
struct Operand<'a> {
    values: &'a [f32],
    lines: usize,
    depth: usize,
    /// Whether the values of a line are adjacent in memory. Otherwise the values of all lines at one depth are.
    line_major: bool,
    side: Side,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Side {
    /// Tiles of 16 lines, each with 16 pairs of values.
    Left,
    /// Tiles of 16 pairs of values, each from 16 lines.
    Right,
}

impl<'a> Operand<'a> {
    fn left(matrix: Matrix<'a>) -> Self {
        let (lines, depth) = matrix.shape();
        Self { values: matrix.values, lines, depth, line_major: matrix.is_plain(), side: Side::Left }
    }

    fn right(matrix: Matrix<'a>) -> Self {
        let (depth, lines) = matrix.shape();
        Self { values: matrix.values, lines, depth, line_major: !matrix.is_plain(), side: Side::Right }
    }
}

/// The `m` x `n` matrix that a product is written to. Threads share it and write to different places.
#[derive(Clone, Copy)]
struct Destination {
    first: *mut f32,
    m: usize,
    n: usize,
}

// SAFETY: each thread writes only to its own strips, see `product`.
unsafe impl Send for Destination {}
// SAFETY: as above.
unsafe impl Sync for Destination {}

/// A row of a tile. It is aligned to 64 bytes, which the unit reads fastest.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Row([u32; TILE]);

impl Row {
    #[inline]
    #[target_feature(enable = "avx512f")]
    fn store(&mut self, pairs: __m512i) {
        // SAFETY: a row is 64 aligned bytes.
        unsafe { _mm512_store_si512(self.0.as_mut_ptr().cast(), pairs) };
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn load(&self) -> __m512i {
        // SAFETY: a row is 64 aligned bytes.
        unsafe { _mm512_load_si512(self.0.as_ptr().cast()) }
    }
}

thread_local! {
    /// Memory for packed operands, kept from one product to the next.
    static ROOM: RefCell<[Vec<Row>; 2]> = const { RefCell::new([Vec::new(), Vec::new()]) };
}

/// Returns the number of rows in the packed tiles of one strip of `steps` steps.
const fn strip_rows<const PARTS: usize>(steps: usize) -> usize {
    steps * PARTS * 2 * TILE
}

/// Multiplies the given strips of the longer side with the whole other side.
///
/// The shorter side is packed in blocks that fit in a core's cache. Each strip of the longer side is packed just before
/// it is multiplied with a block.
///
/// # Safety
/// The unit must be [`available`], and no other thread may write to these strips of `out`.
unsafe fn multiply_strips<const PARTS: usize>(
    left: Operand,
    right: Operand,
    strips: std::ops::Range<usize>,
    out: Destination,
    into: Accumulate,
) {
    let (packed, streamed) = if left.lines >= right.lines { (right, left) } else { (left, right) };
    let block_lines = packed.lines.min(PACKED_LINES).next_multiple_of(STRIP);
    let block_depth =
        (PACKED_BYTES / (block_lines * PARTS * 2) / STEP * STEP).min(packed.depth.next_multiple_of(STEP));
    ROOM.with_borrow_mut(|[packed_rows, streamed_rows]| {
        let grow = |rows: &mut Vec<Row>, len: usize| {
            if rows.len() < len {
                rows.resize(len, Row([0; TILE]));
            }
        };
        grow(packed_rows, block_lines / STRIP * strip_rows::<PARTS>(block_depth / STEP));
        grow(streamed_rows, strip_rows::<PARTS>(block_depth / STEP));
        // SAFETY: the caller guarantees that the unit is available and that no other thread writes to these strips.
        unsafe {
            let tiles = Tiles::configure();
            for first_line in (0..packed.lines).step_by(block_lines) {
                let packed_strips = (packed.lines - first_line).min(block_lines).div_ceil(STRIP);
                for first_depth in (0..packed.depth).step_by(block_depth) {
                    let depth = (packed.depth - first_depth).min(block_depth);
                    let rows = strip_rows::<PARTS>(depth.div_ceil(STEP));
                    let block_into = if first_depth == 0 { into } else { Accumulate::Add };
                    for (strip, room) in packed_rows.chunks_exact_mut(rows).take(packed_strips).enumerate() {
                        pack::<PARTS>(packed, first_line + strip * STRIP, first_depth, depth, room);
                    }
                    for strip in strips.clone() {
                        let streamed_rows = &mut streamed_rows[..rows];
                        pack::<PARTS>(streamed, strip * STRIP, first_depth, depth, streamed_rows);
                        for (index, packed_rows) in
                            packed_rows.chunks_exact(rows).take(packed_strips).enumerate()
                        {
                            let (line, packed_line) = (strip * STRIP, first_line + index * STRIP);
                            let (left, right, place) = match packed.side {
                                Side::Right => (&*streamed_rows, packed_rows, (line, packed_line)),
                                Side::Left => (packed_rows, &*streamed_rows, (packed_line, line)),
                            };
                            let pair = Pair { left, right, packed: packed_rows };
                            tiles.multiply::<PARTS>(pair, out, place, block_into);
                        }
                    }
                }
            }
        }
    });
}

/// Packs `depth` values of the strip that begins at `line` into tiles. The order is by step, then by part, then by the
/// two tiles of a part. Lines and values past the end are zeros.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pack<const PARTS: usize>(from: Operand, line: usize, first_depth: usize, depth: usize, rows: &mut [Row]) {
    // Depending on the matrix's order, pairs are read as rows of lines or as lines of pairs.
    let turned = from.line_major != (from.side == Side::Left);
    for (step, rows) in rows.chunks_exact_mut(strip_rows::<PARTS>(1)).take(depth.div_ceil(STEP)).enumerate() {
        let at = first_depth + step * STEP;
        let depth = (first_depth + depth - at).min(STEP);
        for half in 0..2 {
            let line = line + half * TILE;
            let lines = from.lines.saturating_sub(line).min(TILE);
            let tiles = &mut rows[half * TILE..];
            if lines < TILE || depth < STEP {
                tiles.chunks_mut(2 * TILE).for_each(|tile| tile[..TILE].fill(Row([0; TILE])));
            }
            if from.line_major {
                pack_lines::<PARTS>(from, line, lines, at, depth, tiles);
            } else {
                pack_depths::<PARTS>(from, line, lines, at, depth, tiles);
            }
        }
        if turned {
            rows.as_chunks_mut::<TILE>().0.iter_mut().for_each(|tile| transpose(tile));
        }
    }
}

/// Returns a mask of the lowest `count` bits.
fn mask(count: usize) -> __mmask16 {
    ((1u32 << count) - 1) as __mmask16
}

/// Writes the parts of up to 32 adjacent values for each line, as a row of pairs in each part's tile.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pack_lines<const PARTS: usize>(
    from: Operand,
    line: usize,
    lines: usize,
    at: usize,
    depth: usize,
    tiles: &mut [Row],
) {
    /// Number of values between the current position and the prefetched position: two steps.
    const AHEAD: usize = 2 * STEP;
    let masks = (mask(depth.min(16)), mask(depth.saturating_sub(16)));
    // Word j of the result is the upper half of value j of both vectors together.
    let upper_halves = _mm512_set_epi16(
        63, 61, 59, 57, 55, 53, 51, 49, 47, 45, 43, 41, 39, 37, 35, 33, 31, 29, 27, 25, 23, 21, 19, 17, 15,
        13, 11, 9, 7, 5, 3, 1,
    );
    for row in 0..lines {
        let start = (line + row) * from.depth + at;
        let values = from.values[start..start + depth].as_ptr();
        _mm_prefetch::<_MM_HINT_T0>(values.wrapping_add(AHEAD).cast());
        _mm_prefetch::<_MM_HINT_T0>(values.wrapping_add(AHEAD + 16).cast());
        // SAFETY: the masks exclude values past `depth`, and a masked load does not access excluded values.
        let (mut low, mut high) = unsafe {
            (_mm512_maskz_loadu_ps(masks.0, values), _mm512_maskz_loadu_ps(masks.1, values.wrapping_add(16)))
        };
        if PARTS == 1 {
            let rounded = _mm512_cvtne2ps_pbh(high, low);
            // SAFETY: both types are 512 bits that may have any value.
            tiles[row].store(unsafe { std::mem::transmute::<__m512bh, __m512i>(rounded) });
            continue;
        }
        for part in 0..PARTS {
            let (bits_low, bits_high) = (_mm512_castps_si512(low), _mm512_castps_si512(high));
            tiles[part * 2 * TILE + row].store(_mm512_permutex2var_epi16(bits_low, upper_halves, bits_high));
            (low, high) = (rest(low), rest(high));
        }
    }
}

/// Writes the parts of adjacent lines' values for each pair of up to 32 depths, as a row of lines in each part's tile.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pack_depths<const PARTS: usize>(
    from: Operand,
    line: usize,
    lines: usize,
    at: usize,
    depth: usize,
    tiles: &mut [Row],
) {
    let lines_there = mask(lines);
    let load = |depth_at: usize| {
        if depth_at >= at + depth || lines == 0 {
            return _mm512_setzero_ps();
        }
        let start = depth_at * from.lines + line;
        let values = from.values[start..start + lines].as_ptr();
        _mm_prefetch::<_MM_HINT_T0>(values.wrapping_add(STEP * from.lines).cast());
        // SAFETY: the slice holds the `lines` values that the mask includes.
        unsafe { _mm512_maskz_loadu_ps(lines_there, values) }
    };
    for pair in 0..depth.div_ceil(2) {
        let (mut even, mut odd) = (load(at + 2 * pair), load(at + 2 * pair + 1));
        if PARTS == 1 {
            (even, odd) = (rounded(even), rounded(odd));
        }
        for part in 0..PARTS {
            let upper = _mm512_and_si512(_mm512_castps_si512(odd), _mm512_set1_epi32(UPPER_HALF));
            let lower = _mm512_srli_epi32::<16>(_mm512_castps_si512(even));
            tiles[part * 2 * TILE + pair].store(_mm512_or_si512(lower, upper));
            (even, odd) = (rest(even), rest(odd));
        }
    }
}

/// The bits of an f32 that a bf16 keeps.
const UPPER_HALF: i32 = 0xffff_0000_u32 as i32;

/// Returns the exact remainder of values after their bf16 part is subtracted.
#[inline]
#[target_feature(enable = "avx512f")]
fn rest(values: __m512) -> __m512 {
    let part = _mm512_and_si512(_mm512_castps_si512(values), _mm512_set1_epi32(UPPER_HALF));
    _mm512_sub_ps(values, _mm512_castsi512_ps(part))
}

/// Returns the values rounded to the nearest bf16.
#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn rounded(values: __m512) -> __m512 {
    // SAFETY: both types are 256 bits that may have any value.
    let halves = unsafe { std::mem::transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(values)) };
    _mm512_castsi512_ps(_mm512_slli_epi32::<16>(_mm512_cvtepu16_epi32(halves)))
}

/// Transposes a tile of 16 x 16 numbers with 32 bits each.
#[inline]
#[target_feature(enable = "avx512f")]
fn transpose(tile: &mut [Row; TILE]) {
    let rows: [__m512i; TILE] = std::array::from_fn(|row| tile[row].load());
    let mut pairs = rows;
    for i in (0..TILE).step_by(2) {
        pairs[i] = _mm512_unpacklo_epi32(rows[i], rows[i + 1]);
        pairs[i + 1] = _mm512_unpackhi_epi32(rows[i], rows[i + 1]);
    }
    let mut fours = pairs;
    for i in (0..TILE).step_by(4) {
        for j in 0..2 {
            fours[i + 2 * j] = _mm512_unpacklo_epi64(pairs[i + j], pairs[i + j + 2]);
            fours[i + 2 * j + 1] = _mm512_unpackhi_epi64(pairs[i + j], pairs[i + j + 2]);
        }
    }
    // Each row now holds, in each quarter, one column of four rows.
    let mut eights = fours;
    for i in 0..4 {
        for half in 0..2 {
            let (above, below) = (fours[8 * half + i], fours[8 * half + 4 + i]);
            eights[8 * half + i] = _mm512_shuffle_i32x4::<0b10_00_10_00>(above, below);
            eights[8 * half + 4 + i] = _mm512_shuffle_i32x4::<0b11_01_11_01>(above, below);
        }
    }
    let mut columns = eights;
    for i in 0..8 {
        // `eights[i]` holds quarters 0 and 2 of column group i (i < 4), or 1 and 3 (i >= 4), of rows 0 to 7.
        let (upper, lower) = (eights[i], eights[8 + i]);
        columns[i] = _mm512_shuffle_i32x4::<0b10_00_10_00>(upper, lower);
        columns[8 + i] = _mm512_shuffle_i32x4::<0b11_01_11_01>(upper, lower);
    }
    tile.iter_mut().zip(columns).for_each(|(row, column)| row.store(column));
}

/// Two packed strips that are multiplied.
#[derive(Clone, Copy)]
struct Pair<'a> {
    left: &'a [Row],
    right: &'a [Row],
    /// The strip that lies in the second-level cache and is prefetched.
    packed: &'a [Row],
}

/// The tile registers of the calling thread, configured as eight tiles of 16 x 64 bytes until this value is dropped.
///
/// It stays on its thread, because the registers of another thread are not configured.
struct Tiles(PhantomData<*const ()>);

#[repr(C, align(64))]
struct Configuration {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

impl Tiles {
    /// # Safety
    /// The processor must have the unit.
    unsafe fn configure() -> Self {
        let mut configuration =
            Configuration { palette: 1, start_row: 0, reserved: [0; 14], row_bytes: [0; 16], rows: [0; 16] };
        configuration.row_bytes[..8].fill(64);
        configuration.rows[..8].fill(TILE as u8);
        // SAFETY: the configuration has 64 bytes in the layout of palette 1 (Intel SDM, LDTILECFG).
        unsafe { asm!("ldtilecfg [{}]", in(reg) &configuration, options(nostack, readonly)) };
        Self(PhantomData)
    }

    /// Computes `out[place..] = a b`, or `out[place..] += a b`, for two packed strips.
    ///
    /// # Safety
    /// No other thread may access the 32 x 32 values that begin at `place` (row, column).
    unsafe fn multiply<const PARTS: usize>(
        &self,
        pair: Pair,
        out: Destination,
        place: (usize, usize),
        into: Accumulate,
    ) {
        let (row, column) = place;
        let (rows, columns) = ((out.m - row).min(STRIP), (out.n - column).min(STRIP));
        // SAFETY: the caller guarantees the place, and rows and columns are limited to the matrix.
        unsafe {
            let first = out.first.add(row * out.n + column);
            if into == Accumulate::Overwrite && rows == STRIP && columns == STRIP {
                self.kernel::<PARTS>(pair, first, out.n);
                return;
            }
            let mut block = [0.0f32; STRIP * STRIP];
            self.kernel::<PARTS>(pair, block.as_mut_ptr(), STRIP);
            for (row, block) in block.chunks_exact(STRIP).take(rows).enumerate() {
                let line = std::slice::from_raw_parts_mut(first.add(row * out.n), columns);
                match into {
                    Accumulate::Overwrite => line.copy_from_slice(&block[..columns]),
                    Accumulate::Add => super::add_to(line, block),
                }
            }
        }
    }

    /// Computes `out = a b` for two packed strips: 32 x 32 values, with `stride` values from row to row.
    ///
    /// The smallest products are added first. With three parts, the order (a0 b2, a0 b1, a1 b1, a1 b0, a2 b0, a0 b0)
    /// changes one side at a time. So 14 tiles are loaded for 24 products of tiles.
    unsafe fn kernel<const PARTS: usize>(&self, pair: Pair, out: *mut f32, stride: usize) {
        let Pair { left: a, right: b, packed } = pair;
        /// Loads the two tiles of a part of one side.
        macro_rules! load {
            (a, $part:literal) => {
                concat!(
                    "tileloadd tmm4, [{a} + {row} + ",
                    $part,
                    "*2048]\n",
                    "tileloadd tmm5, [{a} + {row} + ",
                    $part,
                    "*2048 + 1024]"
                )
            };
            (b, $part:literal) => {
                concat!(
                    "tileloadd tmm6, [{b} + {row} + ",
                    $part,
                    "*2048]\n",
                    "tileloadd tmm7, [{b} + {row} + ",
                    $part,
                    "*2048 + 1024]"
                )
            };
        }
        /// Adds the four products of the loaded tiles, and prefetches a kilobyte of the packed side's next step from
        /// the second-level cache.
        macro_rules! multiply {
            ($ahead:literal) => {
                concat!(
                    "tdpbf16ps tmm0, tmm4, tmm6\n",
                    ".irp line, 0, 64, 128, 192, 256, 320, 384, 448\n",
                    "prefetcht0 [{packed} + {bytes} + ",
                    $ahead,
                    "*1024 + \\line]\n",
                    ".endr\n",
                    "tdpbf16ps tmm1, tmm4, tmm7\n",
                    ".irp line, 512, 576, 640, 704, 768, 832, 896, 960\n",
                    "prefetcht0 [{packed} + {bytes} + ",
                    $ahead,
                    "*1024 + \\line]\n",
                    ".endr\n",
                    "tdpbf16ps tmm2, tmm5, tmm6\n",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                )
            };
        }
        macro_rules! run {
            ($($step:expr,)*) => {
                asm!(
                    "tilezero tmm0",
                    "tilezero tmm1",
                    "tilezero tmm2",
                    "tilezero tmm3",
                    "2:",
                    $($step,)*
                    "add {a}, {bytes}",
                    "add {b}, {bytes}",
                    "add {packed}, {bytes}",
                    "dec {steps}",
                    "jnz 2b",
                    "tilestored [{out} + {stride}], tmm0",
                    "tilestored [{out} + {stride} + 64], tmm1",
                    "tilestored [{below} + {stride}], tmm2",
                    "tilestored [{below} + {stride} + 64], tmm3",
                    a = inout(reg) a.as_ptr() => _,
                    b = inout(reg) b.as_ptr() => _,
                    packed = inout(reg) packed.as_ptr() => _,
                    steps = inout(reg) a.len() / strip_rows::<PARTS>(1) => _,
                    bytes = const PARTS as i32 * 2 * 1024,
                    row = in(reg) 64usize,
                    out = in(reg) out,
                    below = in(reg) out.wrapping_add(TILE * stride),
                    stride = in(reg) stride * 4,
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                    out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                    options(nostack),
                )
            };
        }
        debug_assert_eq!(a.len(), b.len());
        // SAFETY: the strips are read from their first row to their last, and the caller guarantees that `out` is
        // valid.
        unsafe {
            if PARTS == 1 {
                run!(load!(a, 0), load!(b, 0), multiply!(0),);
            } else {
                run!(
                    load!(a, 0),
                    load!(b, 2),
                    multiply!(0),
                    load!(b, 1),
                    multiply!(1),
                    load!(a, 1),
                    multiply!(2),
                    load!(b, 0),
                    multiply!(3),
                    load!(a, 2),
                    multiply!(4),
                    load!(a, 0),
                    multiply!(5),
                );
            }
        }
    }
}

impl Drop for Tiles {
    fn drop(&mut self) {
        // SAFETY: the unit is available. Tiles in their initial state are not saved at context switches.
        unsafe { asm!("tilerelease", options(nostack, nomem)) };
    }
}
