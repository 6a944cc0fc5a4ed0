//! HTTP/1.1 for a few clients: what a request may cost is bounded before it is read.
//!
//! A library that reads bodies for its caller would allocate what `Content-Length` claims. Here a head is
//! at most [`MAX_HEAD`] bytes, a body at most what the service allows, and both have a time limit.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Most bytes of a request line with its headers.
const MAX_HEAD: usize = 16 * 1024;
/// How long a head may take from its first byte, and a body from its head.
const MAX_TIME: Duration = Duration::from_secs(20);
/// How long a connection may be silent between two requests.
const MAX_IDLE: Duration = Duration::from_secs(60);
/// How often a silent connection looks whether the service stops.
const POLL: Duration = Duration::from_millis(100);

/// A request without its body.
pub struct Head {
    pub method: String,
    pub path: String,
    headers: Vec<(String, String)>,
    /// Bytes of its body.
    pub length: u64,
    /// Whether another request may follow on the connection.
    keep_alive: bool,
}

impl Head {
    /// The value of a header.
    pub fn header(&self, name: &str) -> Option<&str> {
        let mut found = self.headers.iter();
        let found = found.find(|(n, _)| n.eq_ignore_ascii_case(name))?;
        Some(&found.1)
    }
}

/// What is answered.
#[derive(Debug)]
pub struct Response {
    pub status: u16,
    kind: &'static str,
    body: Vec<u8>,
    /// Seconds after which to try again.
    retry_after: Option<u64>,
}

impl Response {
    pub fn new(kind: &'static str, body: impl Into<Vec<u8>>) -> Self {
        Self {
            status: 200,
            kind,
            body: body.into(),
            retry_after: None,
        }
    }

    pub fn json(value: &serde_json::Value) -> Self {
        Self::new("application/json", format!("{value:#}\n"))
    }

    /// A refusal in plain words.
    pub fn refusal(status: u16, message: impl std::fmt::Display) -> Self {
        Self {
            status,
            ..Self::new("text/plain; charset=utf-8", format!("{message}\n"))
        }
    }

    pub fn with_status(self, status: u16) -> Self {
        Self { status, ..self }
    }

    /// Answers a connection of which nothing was read.
    pub fn send_unasked(&self, mut stream: &TcpStream) {
        let bytes = [self.head(false), self.body.clone()].concat();
        // A client that is gone needs no answer.
        let _ = stream.write_all(&bytes);
        let _ = stream.shutdown(Shutdown::Write);
    }

    fn head(&self, stays: bool) -> Vec<u8> {
        let retry_after = (self.retry_after)
            .map(|s| format!("Retry-After: {s}\r\n"))
            .unwrap_or_default();
        let head = format!(
            "HTTP/1.1 {} {}\r\nContent-Type: {}\r\nContent-Length: {}\r\nCache-Control: no-store\r\n\
             X-Content-Type-Options: nosniff\r\nConnection: {}\r\n{retry_after}\r\n",
            self.status,
            reason(self.status),
            self.kind,
            self.body.len(),
            if stays { "keep-alive" } else { "close" },
        );
        head.into_bytes()
    }

    /// The message of a refusal.
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).trim_end().to_owned()
    }

    pub fn retry_after(self, seconds: u64) -> Self {
        let retry_after = Some(seconds);
        Self {
            retry_after,
            ..self
        }
    }
}

/// One connection and what was read of it ahead.
pub struct Connection<'a> {
    stream: TcpStream,
    /// Read, and not yet used.
    ahead: Vec<u8>,
    stop: &'a AtomicBool,
}

/// Why no request came.
pub enum NoRequest {
    /// The client is gone, silent for long, or the service stops: nothing to answer.
    Closed,
    /// To be answered, and the connection closed.
    Bad(Response),
}

impl<'a> Connection<'a> {
    /// # Errors
    /// When the operating system refuses a time limit.
    pub fn new(stream: TcpStream, stop: &'a AtomicBool) -> std::io::Result<Self> {
        stream.set_nonblocking(false)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(POLL))?;
        stream.set_write_timeout(Some(MAX_TIME))?;
        Ok(Self {
            stream,
            ahead: vec![],
            stop,
        })
    }

    /// Reads the head of the next request.
    ///
    /// # Errors
    /// When none comes, or what comes is none.
    pub fn head(&mut self) -> Result<Head, NoRequest> {
        let mut deadline = Instant::now() + MAX_IDLE;
        let mut begun = false;
        loop {
            if !self.ahead.is_empty() {
                if !begun {
                    (begun, deadline) = (true, Instant::now() + MAX_TIME);
                }
                if let Some((head, used)) = parse(&self.ahead).map_err(NoRequest::Bad)? {
                    self.ahead.drain(..used);
                    return Ok(head);
                }
                if self.ahead.len() >= MAX_HEAD {
                    let refusal = format!("the headers are longer than {MAX_HEAD} bytes");
                    return Err(NoRequest::Bad(Response::refusal(431, refusal)));
                }
            } else if self.stop.load(Ordering::Relaxed) {
                return Err(NoRequest::Closed);
            }
            let mut bytes = [0; 4096];
            match self.read_some(&mut bytes, deadline) {
                Ok(0) => return Err(NoRequest::Closed),
                Ok(n) => self.ahead.extend_from_slice(&bytes[..n]),
                Err(e) if e.kind() == ErrorKind::TimedOut && begun => {
                    let refusal = format!("no whole request within {} s", MAX_TIME.as_secs());
                    return Err(NoRequest::Bad(Response::refusal(408, refusal)));
                }
                // Nothing for a moment: look around.
                Err(e) if e.kind() == ErrorKind::WouldBlock => {}
                Err(_) => return Err(NoRequest::Closed),
            }
        }
    }

    /// Reads the body that belongs to `head`, which must not be longer than the caller allows.
    ///
    /// # Errors
    /// When the client ends or tarries before it is whole.
    pub fn body(&mut self, head: &Head) -> Result<Vec<u8>, NoRequest> {
        let expects = head.header("Expect");
        if expects.is_some_and(|e| e.eq_ignore_ascii_case("100-continue")) {
            let said = self.stream.write_all(b"HTTP/1.1 100 Continue\r\n\r\n");
            said.map_err(|_| NoRequest::Closed)?;
        }
        let length = head.length as usize;
        let deadline = Instant::now() + MAX_TIME;
        let mut body: Vec<u8> = self.ahead.drain(..length.min(self.ahead.len())).collect();
        let mut bytes = vec![0; 64 * 1024];
        while body.len() < length {
            let wanted = (length - body.len()).min(bytes.len());
            match self.read_some(&mut bytes[..wanted], deadline) {
                Ok(0) => return Err(NoRequest::Closed),
                Ok(n) => body.extend_from_slice(&bytes[..n]),
                Err(e) if e.kind() == ErrorKind::WouldBlock => {}
                Err(e) if e.kind() == ErrorKind::TimedOut => {
                    let refusal = format!(
                        "{} of {length} bytes came within {} s",
                        body.len(),
                        MAX_TIME.as_secs()
                    );
                    return Err(NoRequest::Bad(Response::refusal(408, refusal)));
                }
                Err(_) => return Err(NoRequest::Closed),
            }
        }
        Ok(body)
    }

    /// Reads what is there; `WouldBlock` when nothing is for a moment, `TimedOut` past the deadline.
    fn read_some(&mut self, bytes: &mut [u8], deadline: Instant) -> std::io::Result<usize> {
        if Instant::now() >= deadline {
            return Err(ErrorKind::TimedOut.into());
        }
        match self.stream.read(bytes) {
            // What a read that waited in vain is called differs between systems.
            Err(e) if [ErrorKind::TimedOut, ErrorKind::Interrupted].contains(&e.kind()) => {
                Err(ErrorKind::WouldBlock.into())
            }
            other => other,
        }
    }

    /// Answers `head`, or what was none; whether the connection goes on.
    pub fn answer(&mut self, head: Option<&Head>, body_read: bool, response: &Response) -> bool {
        let stays =
            body_read && head.is_some_and(|h| h.keep_alive) && !self.stop.load(Ordering::Relaxed);
        let mut bytes = response.head(stays);
        if head.is_none_or(|h| h.method != "HEAD") {
            bytes.extend_from_slice(&response.body);
        }
        let sent = self.stream.write_all(&bytes).is_ok();
        if sent && !stays {
            self.part();
        }
        sent && stays
    }

    /// Ends the connection so that the client can read the answer: closing with bytes of a refused body
    /// unread would reset it, and the answer with it.
    fn part(&mut self) {
        let deadline = Instant::now() + Duration::from_secs(2);
        if self.stream.shutdown(Shutdown::Write).is_err() {
            return;
        }
        let mut bytes = vec![0; 64 * 1024];
        loop {
            match self.read_some(&mut bytes, deadline) {
                Ok(n) if n > 0 => {}
                Err(e) if e.kind() == ErrorKind::WouldBlock => {}
                _ => return,
            }
        }
    }
}

/// The head in front of `bytes` and its length there, when it is whole.
fn parse(bytes: &[u8]) -> Result<Option<(Head, usize)>, Response> {
    let mut headers = [httparse::EMPTY_HEADER; 64];
    let mut request = httparse::Request::new(&mut headers);
    let used = match request.parse(bytes) {
        Ok(httparse::Status::Complete(used)) => used,
        Ok(httparse::Status::Partial) => return Ok(None),
        Err(e) => return Err(Response::refusal(400, format!("no HTTP request: {e}"))),
    };
    let text = |value: &[u8]| String::from_utf8_lossy(value).trim().to_owned();
    let headers: Vec<(String, String)> = (request.headers.iter())
        .map(|h| (h.name.to_owned(), text(h.value)))
        .collect();
    let mut head = Head {
        method: request.method.unwrap_or_default().to_owned(),
        path: request.path.unwrap_or_default().to_owned(),
        headers,
        length: 0,
        keep_alive: request.version == Some(1),
    };
    if head.header("Transfer-Encoding").is_some() {
        let refusal = "the length of the body must be known\n  cure: send Content-Length, not Transfer-Encoding";
        return Err(Response::refusal(411, refusal));
    }
    let lengths = head.headers.iter();
    let mut lengths = lengths.filter(|(n, _)| n.eq_ignore_ascii_case("Content-Length"));
    if let Some((_, length)) = lengths.next() {
        // Digits only: `parse` would take a sign as well.
        let digits = length.bytes().all(|b| b.is_ascii_digit());
        head.length = (length.parse().ok())
            .filter(|_| digits && lengths.next().is_none())
            .ok_or_else(|| Response::refusal(400, "Content-Length must be one number"))?;
    }
    let connection = head.header("Connection").unwrap_or_default();
    head.keep_alive &= !connection.to_ascii_lowercase().contains("close");
    Ok(Some((head, used)))
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        400 => "Bad Request",
        401 => "Unauthorized",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        408 => "Request Timeout",
        411 => "Length Required",
        413 => "Content Too Large",
        415 => "Unsupported Media Type",
        422 => "Unprocessable Content",
        429 => "Too Many Requests",
        431 => "Request Header Fields Too Large",
        503 => "Service Unavailable",
        _ => "Internal Server Error",
    }
}

/// The fields of a `multipart/form-data` body (RFC 7578): name and bytes.
///
/// # Errors
/// What is wrong with it, in words.
pub fn form<'b>(kind: &str, body: &'b [u8]) -> Result<Vec<(String, &'b [u8])>, String> {
    let boundary = (kind.split(';').map(str::trim))
        .find_map(|part| part.strip_prefix("boundary="))
        .map(|b| b.trim_matches('"'))
        .filter(|b| !b.is_empty() && b.len() <= 70)
        .ok_or("Content-Type names no boundary")?;
    let delimiter = format!("\r\n--{boundary}");
    // The first delimiter has no line end before it.
    let mut rest = (body.strip_prefix(&delimiter.as_bytes()[2..]))
        .ok_or("the body does not start with its boundary")?;
    let mut fields = vec![];
    while let Some(part) = rest.strip_prefix(b"\r\n") {
        let end = find(part, delimiter.as_bytes()).ok_or("the last part has no end")?;
        let mut headers = [httparse::EMPTY_HEADER; 16];
        let (used, headers) = match httparse::parse_headers(&part[..end], &mut headers) {
            Ok(httparse::Status::Complete(parsed)) => parsed,
            _ => return Err("the headers of a part are broken".into()),
        };
        let disposition = (headers.iter())
            .find(|h| h.name.eq_ignore_ascii_case("Content-Disposition"))
            .map(|h| String::from_utf8_lossy(h.value).into_owned())
            .unwrap_or_default();
        let name = (disposition.split(';').map(str::trim))
            .find_map(|d| d.strip_prefix("name="))
            .ok_or("a part has no name")?;
        fields.push((name.trim_matches('"').to_owned(), &part[used..end]));
        if fields.len() > 16 {
            return Err("more than 16 parts".into());
        }
        rest = &part[end + delimiter.len()..];
    }
    match rest.starts_with(b"--") {
        true => Ok(fields),
        false => Err("it does not end with its boundary".into()),
    }
}

/// Where `needle` first is.
fn find(haystack: &[u8], needle: &[u8]) -> Option<usize> {
    // Images hold every byte about as often; the first byte of the needle rules out most places.
    let mut from = 0;
    while let Some(at) = haystack[from..].iter().position(|b| *b == needle[0]) {
        if haystack[from + at..].starts_with(needle) {
            return Some(from + at);
        }
        from += at + 1;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    const KIND: &str = "multipart/form-data; boundary=X";

    #[test]
    fn a_form_gives_back_its_fields_whatever_bytes_they_hold() {
        let bytes: Vec<u8> = (0..=255).cycle().take(5000).collect();
        let mut body =
            b"--X\r\nContent-Disposition: form-data; name=\"left\"; filename=\"a.png\"\r\n\r\n"
                .to_vec();
        body.extend_from_slice(&bytes);
        body.extend_from_slice(
            b"\r\n--X\r\ncontent-disposition: form-data; name=time\r\n\r\n1.5\r\n--X--\r\n",
        );
        let fields = form(KIND, &body).unwrap();
        assert_eq!(fields.len(), 2);
        assert_eq!(fields[0], ("left".to_owned(), &bytes[..]));
        assert_eq!(fields[1], ("time".to_owned(), &b"1.5"[..]));
        // No prefix of it is a form, and none is a panic.
        for end in 0..body.len() - 4 {
            assert!(form(KIND, &body[..end]).is_err(), "{end}");
        }
    }

    #[test]
    fn heads_are_read_whole_or_refused() {
        let head = b"POST /pairs HTTP/1.1\r\nHost: a\r\ncontent-length: 12\r\n\r\nbody";
        for end in 0..head.len() - 4 {
            assert!(matches!(parse(&head[..end]), Ok(None)), "{end}");
        }
        let (parsed, used) = parse(head).unwrap().unwrap();
        assert_eq!((parsed.length, used), (12, head.len() - 4));
        assert_eq!((&*parsed.method, &*parsed.path), ("POST", "/pairs"));
        assert!(parsed.keep_alive && parsed.header("HOST") == Some("a"));
        let refused = |headers: &str| {
            let head = format!("POST / HTTP/1.1\r\n{headers}\r\n\r\n");
            parse(head.as_bytes()).err().map(|r| r.status)
        };
        assert_eq!(refused("Content-Length: -1"), Some(400));
        assert_eq!(refused("Content-Length: +1"), Some(400));
        assert_eq!(refused("Content-Length: 99999999999999999999"), Some(400));
        assert_eq!(refused("Content-Length: 1\r\nContent-Length: 2"), Some(400));
        assert_eq!(refused("Transfer-Encoding: chunked"), Some(411));
        assert_eq!(refused("Bad Header: 1"), Some(400));
    }
}
