//! Refuses requests of other machines and of other sites.
//!
//! The server listens on 127.0.0.1, which other machines can't reach. All users of this machine can. And any site that
//! is open in a browser of this machine can send requests there. Its requests name its own address in `Origin`, or in
//! `Host` if its name was made to resolve to 127.0.0.1.

use super::FILES;
use super::answers::Failure;
use super::http::Request;

/// The names of this machine in a `Host` header, without the port.
const NAMES: [&str; 3] = ["127.0.0.1", "localhost", "[::1]"];

/// Checks that a request comes from a page of this server, or from a program of this machine. A link from another site
/// to the page may be followed.
///
/// # Errors
/// When the request's `Host` is not this machine, or it comes from another site.
pub fn check(request: &Request) -> Result<(), Failure> {
    let header = |name: &str| {
        let mut found = request.headers.iter().filter(|(key, _)| key.eq_ignore_ascii_case(name));
        let first = found.next().map(|(_, value)| value.as_str());
        // No browser sends two values of one of these headers.
        if found.next().is_some() { Err(Failure::Foreign) } else { Ok(first) }
    };
    let host = header("host")?.ok_or(Failure::Foreign)?;
    let name = host.rsplit_once(':').filter(|(_, port)| !port.ends_with(']')).map_or(host, |(name, _)| name);
    let is_local = NAMES.iter().any(|local| name.eq_ignore_ascii_case(local));
    let is_own =
        |origin: &str| origin.strip_prefix("http://").is_some_and(|from| from.eq_ignore_ascii_case(host));
    let is_same_site = |site: &str| matches!(site, "same-origin" | "none");
    let opens_page = request.method == "GET"
        && FILES.iter().any(|(path, ..)| *path == request.path())
        && header("sec-fetch-mode")? == Some("navigate")
        && header("sec-fetch-dest")? == Some("document");
    let allowed = is_local
        && header("origin")?.is_none_or(is_own)
        && (opens_page || header("sec-fetch-site")?.is_none_or(is_same_site));
    if allowed { Ok(()) } else { Err(Failure::Foreign) }
}
