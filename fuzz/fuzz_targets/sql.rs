//! Any text as a query over empty tables.
#![no_main]

use harness_catalog::query;
use harness_registry::Registry;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|sql: &str| {
    let _ = query(&Registry::new("/nonexistent"), sql);
});
