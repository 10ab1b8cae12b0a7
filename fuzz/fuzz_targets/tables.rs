//! Any bytes as a Parquet table. The seal refuses all but intact ones: Polars' decoder would end the process at some.
#![no_main]

use harness_tables::TableFile;
use libfuzzer_sys::fuzz_target;
use std::path::Path;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(file) = TableFile::new(Path::new("fuzz.parquet"), bytes.to_vec()) {
        let _ = file.footer();
        let _ = file.table(None);
    }
});
