//! The container of a recording: MCAP, <https://mcap.dev/spec>. Chunks that are not compressed, with all of their
//! indexes, so that a viewer finds any moment at once; numbers are little-endian.

use std::collections::BTreeMap;
use std::io::{self, Write};

const MAGIC: &[u8] = b"\x89MCAP0\r\n";
/// A chunk is written when it has so many bytes.
const CHUNK: usize = 1 << 20;

/// The first byte of a record.
#[derive(Clone, Copy)]
enum Op {
    Header = 0x01,
    Footer = 0x02,
    Schema = 0x03,
    Channel = 0x04,
    Message = 0x05,
    Chunk = 0x06,
    MessageIndex = 0x07,
    ChunkIndex = 0x08,
    Statistics = 0x0b,
    SummaryOffset = 0x0e,
    DataEnd = 0x0f,
}

/// Writes a file from its first byte to its last. In memory are one chunk and the index of those before.
pub struct Writer<W: Write> {
    out: W,
    /// Bytes written.
    position: u64,
    /// Records of the chunk in hand.
    chunk: Vec<u8>,
    /// Time and place of its messages, by channel.
    index: BTreeMap<u16, Vec<(u64, u64)>>,
    /// All records of these kinds, which the end of the file repeats.
    schemas: Vec<u8>,
    channels: Vec<u8>,
    chunk_indexes: Vec<u8>,
    chunks: u32,
    /// Messages of each channel.
    counts: BTreeMap<u16, u64>,
    /// Earliest and latest message.
    times: Option<(u64, u64)>,
}

impl<W: Write> Writer<W> {
    pub fn new(out: W) -> io::Result<Self> {
        let mut writer = Self {
            out,
            position: 0,
            chunk: vec![],
            index: BTreeMap::new(),
            schemas: vec![],
            channels: vec![],
            chunk_indexes: vec![],
            chunks: 0,
            counts: BTreeMap::new(),
            times: None,
        };
        writer.put(MAGIC)?;
        let library = concat!("barchan ", env!("CARGO_PKG_VERSION"));
        let header = record(Op::Header, &[&text(""), &text(library)]);
        writer.put(&header)?;
        Ok(writer)
    }

    /// A topic of messages in JSON, whose schema is JSON as well; its number. Ends the file's range of numbers at
    /// 65535 topics.
    pub fn channel(&mut self, topic: &str, schema_name: &str, schema: &str) -> io::Result<u16> {
        let id = u16::try_from(self.counts.len() + 1).map_err(io::Error::other)?;
        let number = id.to_le_bytes();
        let schema = record(
            Op::Schema,
            &[
                &number,
                &text(schema_name),
                &text("jsonschema"),
                &text(schema),
            ],
        );
        let metadata = text("");
        let channel = record(
            Op::Channel,
            &[&number, &number, &text(topic), &text("json"), &metadata],
        );
        self.chunk.extend(schema.iter().chain(&channel));
        self.schemas.extend(schema);
        self.channels.extend(channel);
        self.counts.insert(id, 0);
        Ok(id)
    }

    /// A message at a time, nanoseconds since 1970.
    pub fn message(&mut self, channel: u16, time: u64, data: &[u8]) -> io::Result<()> {
        let count = self.counts.entry(channel).or_default();
        *count += 1;
        let place = self.chunk.len() as u64;
        self.index.entry(channel).or_default().push((time, place));
        let (first, last) = self.times.unwrap_or((time, time));
        self.times = Some((first.min(time), last.max(time)));
        // Counted within its channel; what is beyond 32 bits begins anew.
        let (sequence, time) = (*count as u32, time.to_le_bytes());
        let head = [&channel.to_le_bytes()[..], &sequence.to_le_bytes()];
        let message = record(Op::Message, &[head[0], head[1], &time, &time, data]);
        self.chunk.extend(message);
        match self.chunk.len() < CHUNK {
            true => Ok(()),
            false => self.end_chunk(),
        }
    }

    /// Writes the chunk in hand and the indexes of its messages, and keeps where they are.
    fn end_chunk(&mut self) -> io::Result<()> {
        let records = std::mem::take(&mut self.chunk);
        let index = std::mem::take(&mut self.index);
        let times = || index.values().flatten().map(|(time, _)| *time);
        let (Some(first), Some(last)) = (times().min(), times().max()) else {
            return Ok(());
        };
        let (first, last) = (first.to_le_bytes(), last.to_le_bytes());
        let (start, size) = (self.position, (records.len() as u64).to_le_bytes());
        let crc = crc32fast::hash(&records).to_le_bytes();
        let compression = text("");
        let chunk = record(
            Op::Chunk,
            &[&first, &last, &size, &crc, &compression, &size, &records],
        );
        self.put(&chunk)?;
        let mut places = vec![];
        let indexes_start = self.position;
        for (channel, messages) in &index {
            places.extend(channel.to_le_bytes());
            places.extend(self.position.to_le_bytes());
            let pairs = (messages.iter()).flat_map(|(time, place)| [*time, *place]);
            let pairs: Vec<u8> = pairs.flat_map(u64::to_le_bytes).collect();
            let channel = channel.to_le_bytes();
            self.put(&record(Op::MessageIndex, &[&channel, &sized(&pairs)]))?;
        }
        let chunk_length = (chunk.len() as u64).to_le_bytes();
        let indexes_length = (self.position - indexes_start).to_le_bytes();
        self.chunk_indexes.extend(record(
            Op::ChunkIndex,
            &[
                &first,
                &last,
                &start.to_le_bytes(),
                &chunk_length,
                &sized(&places),
                &indexes_length,
                &compression,
                &size,
                &size,
            ],
        ));
        self.chunks += 1;
        Ok(())
    }

    /// Writes the last chunk and the summary.
    pub fn finish(mut self) -> io::Result<()> {
        self.end_chunk()?;
        // 0: the file as a whole has no checksum, its chunks have.
        self.put(&record(Op::DataEnd, &[&0u32.to_le_bytes()]))?;

        let (first, last) = self.times.unwrap_or_default();
        let channels = self.counts.len();
        let counts = (self.counts.iter()).flat_map(|(channel, count)| {
            [&channel.to_le_bytes()[..], &count.to_le_bytes()].concat()
        });
        let counts: Vec<u8> = counts.collect();
        let statistics = record(
            Op::Statistics,
            &[
                &self.counts.values().sum::<u64>().to_le_bytes(),
                &(channels as u16).to_le_bytes(),
                &(channels as u32).to_le_bytes(),
                // Attachments, metadata.
                &0u32.to_le_bytes(),
                &0u32.to_le_bytes(),
                &self.chunks.to_le_bytes(),
                &first.to_le_bytes(),
                &last.to_le_bytes(),
                &sized(&counts),
            ],
        );
        let groups = [
            (Op::Schema, std::mem::take(&mut self.schemas)),
            (Op::Channel, std::mem::take(&mut self.channels)),
            (Op::Statistics, statistics),
            (Op::ChunkIndex, std::mem::take(&mut self.chunk_indexes)),
        ];
        let summary_start = self.position;
        let (mut summary, mut offsets) = (vec![], vec![]);
        for (op, records) in groups
            .into_iter()
            .filter(|(_, records)| !records.is_empty())
        {
            let start = (summary_start + summary.len() as u64).to_le_bytes();
            let length = (records.len() as u64).to_le_bytes();
            offsets.extend(record(Op::SummaryOffset, &[&[op as u8], &start, &length]));
            summary.extend(records);
        }
        let offsets_start = summary_start + summary.len() as u64;
        summary.extend(offsets);
        // The checksum is of all up to itself.
        let mut footer = record(
            Op::Footer,
            &[
                &summary_start.to_le_bytes(),
                &offsets_start.to_le_bytes(),
                &[0; 4],
            ],
        );
        footer.truncate(footer.len() - 4);
        summary.extend(footer);
        summary.extend(crc32fast::hash(&summary).to_le_bytes());
        self.put(&summary)?;
        self.put(MAGIC)?;
        self.out.flush()
    }

    fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.out.write_all(bytes)?;
        self.position += bytes.len() as u64;
        Ok(())
    }
}

/// A record of its parts, one after the other.
fn record(op: Op, parts: &[&[u8]]) -> Vec<u8> {
    let length: usize = parts.iter().map(|p| p.len()).sum();
    let mut bytes = Vec::with_capacity(9 + length);
    bytes.push(op as u8);
    bytes.extend((length as u64).to_le_bytes());
    parts.iter().for_each(|p| bytes.extend_from_slice(p));
    bytes
}

/// Bytes after their number: how texts, lists and maps are written.
fn sized(bytes: &[u8]) -> Vec<u8> {
    let length = (bytes.len() as u32).to_le_bytes();
    [&length, bytes].concat()
}

fn text(text: &str) -> Vec<u8> {
    sized(text.as_bytes())
}
