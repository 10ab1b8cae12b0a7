//! Any bytes as a checkpoint or a training's state; the seal, which would refuse nearly all of them, is left out.
#![no_main]

use harness_learning::tensors::TensorFile;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let _ = TensorFile::parse(bytes);
});
