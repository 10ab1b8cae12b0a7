//! Interned names, and enums whose values have names.

use std::collections::BTreeSet;
use std::sync::Mutex;

/// Returns the single copy of a name. The copy is never freed, because names are few and short.
pub fn intern(name: &str) -> &'static str {
    static NAMES: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
    let mut names = NAMES.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    if let Some(known) = names.get(name) {
        return known;
    }
    let name: &'static str = Box::leak(name.into());
    names.insert(name);
    name
}

/// Implements the text, the order, `Display` and serde for a type that wraps an interned name. The names in `$first`
/// come first, and all others follow in alphabetical order.
macro_rules! interned_name {
    ($type:ident, first: $first:ident, refused: $refused:literal) => {
        impl $type {
            /// Creates the value with this name; `None` if the name is not valid.
            pub fn new(name: &str) -> Option<Self> {
                $crate::is_name(name).then(|| Self($crate::intern(name)))
            }

            /// Returns the name in specs, tables and file names.
            pub const fn name(self) -> &'static str {
                self.0
            }

            fn rank(self) -> usize {
                Self::$first.iter().position(|other| *other == self).unwrap_or(Self::$first.len())
            }
        }

        impl Ord for $type {
            fn cmp(&self, other: &Self) -> std::cmp::Ordering {
                (self.rank(), self.0).cmp(&(other.rank(), other.0))
            }
        }

        impl PartialOrd for $type {
            fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
                Some(self.cmp(other))
            }
        }

        impl std::fmt::Display for $type {
            fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.pad(self.0)
            }
        }

        impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.serialize_str(self.0)
            }
        }

        impl<'de> serde::Deserialize<'de> for $type {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let name = String::deserialize(deserializer)?;
                let refused = || serde::de::Error::custom(format!(concat!("'{}' ", $refused), name));
                Self::new(&name).ok_or_else(refused)
            }
        }
    };
}

/// Implements the list of values and their names for an enum. A test checks that the names equal those of serde.
macro_rules! names {
    ($type:ident { $($variant:ident => $name:literal),+ $(,)? }) => {
        impl $type {
            /// Every value, in the order of declaration.
            pub const ALL: &'static [Self] = &[$(Self::$variant),+];

            /// Returns the name in specs, tables and file names.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $name),+ }
            }
        }

        impl std::fmt::Display for $type {
            fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.pad(self.name())
            }
        }
    };
}

pub(crate) use {interned_name, names};
