//! Any text as a spec: refused with a message, or an experiment that stays within its bounds.
#![no_main]

use harness_spec as spec;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    for quick in [false, true] {
        let Ok(experiment) = spec::parse_spec("fuzz.yaml", text, &[], quick) else { continue };
        let is_allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        assert!(experiment.name.len() <= 70 && experiment.name.chars().all(is_allowed));
        assert!(experiment.runs().len() <= 10_000);
        let yaml = experiment.to_yaml();
        assert_eq!(spec::parse_spec("again.yaml", &yaml, &[], false).as_ref(), Ok(&experiment), "{yaml}");
    }
});
