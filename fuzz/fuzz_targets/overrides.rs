//! Any text as overrides, one a line: refused with a message, or an experiment that can be written and read again.
#![no_main]

use harness_spec as spec;
use libfuzzer_sys::fuzz_target;

const SMOKE: &str = include_str!("../../experiments/smoke.yaml");

fuzz_target!(|text: &str| {
    let overrides: Vec<String> = text.lines().map(str::to_owned).collect();
    if let Ok(experiment) = spec::parse_spec("smoke.yaml", SMOKE, &overrides, false) {
        let yaml = experiment.to_yaml();
        assert_eq!(spec::parse_spec("again.yaml", &yaml, &[], false).as_ref(), Ok(&experiment), "{yaml}");
    }
});
