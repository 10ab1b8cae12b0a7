//! The sizes of the finger's modalities, as the models have them.
#![allow(dead_code, reason = "no test program uses all of it")]

pub const JOINTS: usize = 20;
pub const ARM_JOINTS: usize = 3;
pub const FRAME_SIDE: usize = 64;
pub const FRAME_LEN: usize = FRAME_SIDE * FRAME_SIDE * 3;
pub const BOXES: usize = 8;
