// Prints a line for each message of an MCAP file, read with Foxglove's own packages.
// Usage: node read_mcap.mjs NODE_MODULES FILE
import { createRequire } from 'node:module';
import { readFileSync } from 'node:fs';
import { join } from 'node:path';

const [folder, file] = process.argv.slice(2);
const require = createRequire(join(folder, 'any.js'));
const { McapIndexedReader } = require('@mcap/core');
const { parse } = require('@foxglove/rosmsg');
const { MessageReader } = require('@foxglove/rosmsg2-serialization');
const { decompress } = require('fzstd');

const bytes = readFileSync(file);
const readable = {
  size: async () => BigInt(bytes.length),
  read: async (offset, size) => new Uint8Array(bytes.subarray(Number(offset), Number(offset + size))),
};
const reader = await McapIndexedReader.Initialize({
  readable,
  decompressHandlers: { zstd: (packed, size) => decompress(packed, new Uint8Array(Number(size))) },
});
const readers = new Map();
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  if (!readers.has(channel.schemaId)) {
    const schema = reader.schemasById.get(channel.schemaId);
    const text = new TextDecoder().decode(schema.data);
    readers.set(channel.schemaId, new MessageReader(parse(text, { ros2: true })));
  }
  const decoded = readers.get(channel.schemaId).readMessage(message.data);
  console.log(JSON.stringify({
    topic: channel.topic,
    log: message.logTime.toString(),
    publish: message.publishTime.toString(),
    value: decoded.data ?? decoded.generated_power,
  }));
}
