//! HTTP/1.1 for one page on this machine: each connection has a thread and one request, and is then closed.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

/// How long a connection may send nothing. Browsers open some without using them.
const PATIENCE: Duration = Duration::from_secs(10);
/// The largest request, in bytes. A query may have 1 MiB, and longer ones are answered with a message.
const LARGEST: usize = 1 << 24;
/// The most headers of a request.
const MOST_HEADERS: usize = 64;

/// A request.
pub struct Request {
    /// Such as `GET`.
    pub method: String,
    /// The path and the query, such as `/api/runs?version=1`.
    pub target: String,
    /// Names and values. A value that is not UTF-8 is empty.
    pub headers: Vec<(String, String)>,
    pub body: Vec<u8>,
}

impl Request {
    /// The path, such as `/api/runs`.
    pub fn path(&self) -> &str {
        self.target.split('?').next().unwrap_or_default()
    }

    /// What follows the path, such as `version=1`. Often empty.
    pub fn query(&self) -> &str {
        self.target.split_once('?').map_or("", |(_, query)| query)
    }
}

/// A response.
pub struct Response {
    /// Such as `200 OK`.
    pub status: &'static str,
    pub headers: Vec<(&'static str, &'static str)>,
    pub body: String,
}

/// Reads the request of a connection, and writes the response to it. A connection without a whole request is closed.
pub fn answer(mut stream: TcpStream, respond: impl FnOnce(&Request) -> Response) {
    let _ = stream.set_read_timeout(Some(PATIENCE)).and_then(|()| stream.set_write_timeout(Some(PATIENCE)));
    let Some(request) = read(&mut stream) else { return };
    let response = respond(&request);
    let mut text = format!("HTTP/1.1 {}\r\n", response.status);
    for (name, value) in response.headers {
        text += &format!("{name}: {value}\r\n");
    }
    text += &format!("Content-Length: {}\r\nConnection: close\r\n\r\n{}", response.body.len(), response.body);
    // A client that has gone away is ignored.
    let _ = stream.write_all(text.as_bytes());
}

/// Reads a request. `None` if it is malformed or too large, or does not arrive.
fn read(stream: &mut TcpStream) -> Option<Request> {
    let (mut bytes, mut chunk) = (Vec::new(), [0; 1 << 16]);
    loop {
        let count = stream.read(&mut chunk).ok().filter(|count| *count > 0)?;
        bytes.extend_from_slice(&chunk[..count]);
        if bytes.len() > LARGEST {
            return None;
        }
        if let Some(request) = parse(&bytes)? {
            return Some(request);
        }
    }
}

/// The request in `bytes`. `None` if it is malformed, and `Some(None)` if it is not complete.
fn parse(bytes: &[u8]) -> Option<Option<Request>> {
    let mut headers = [httparse::EMPTY_HEADER; MOST_HEADERS];
    let mut head = httparse::Request::new(&mut headers);
    let httparse::Status::Complete(start) = head.parse(bytes).ok()? else { return Some(None) };
    let text = |value: &[u8]| std::str::from_utf8(value).unwrap_or_default().to_owned();
    let headers: Vec<(String, String)> =
        head.headers.iter().map(|header| (header.name.to_owned(), text(header.value))).collect();
    let length = headers.iter().find(|(name, _)| name.eq_ignore_ascii_case("content-length"));
    let length: usize = length.map_or(Some(0), |(_, value)| value.parse().ok())?;
    let Some(body) = bytes[start..].get(..length) else { return Some(None) };
    Some(Some(Request {
        method: head.method?.to_owned(),
        target: head.path?.to_owned(),
        headers,
        body: body.to_vec(),
    }))
}
