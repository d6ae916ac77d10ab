// Stills of the board that were kept in this browser, which survive that the page is loaded again, and
// the archives that take them, and a site, to a USB stick and back.

import { h, remembered } from "./common.js";

const DATABASE = "beltgauge";
const STORE = "stills";

function opened() {
  return new Promise((resolve, reject) => {
    const request = indexedDB.open(DATABASE, 1);
    request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: "key", autoIncrement: true });
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

async function within(mode, work) {
  const database = await opened();
  try {
    return await new Promise((resolve, reject) => {
      const transaction = database.transaction(STORE, mode);
      const request = work(transaction.objectStore(STORE));
      transaction.oncomplete = () => resolve(request.result);
      transaction.onerror = transaction.onabort = () => reject(transaction.error);
    });
  } finally {
    database.close();
  }
}

// A still: folder (lens or belt), size, corners, outline, bytes of its file. It gets a key.
export const keep = (still) => within("readwrite", (store) => store.add(still));
export const kept = () => within("readonly", (store) => store.getAll());
export const forget = (key) => within("readwrite", (store) => store.delete(key));

// Inner corners of a board, its squares and its thickness: usual, least, most; as `calibration.toml` has them.
export const BOARD = { columns: [9, 3, 60], rows: [6, 3, 60], square_mm: [25, 1, 1000], thickness_mm: [3, 0, 200] };
export function boardValue(name) {
  const [usual, least, most] = BOARD[name];
  return Math.min(Math.max(Number(remembered(`board.${name}`) ?? usual) || usual, least), most);
}

// What calibrates the camera: files as in the folder of a stick.
export function forCalibration(stills) {
  const settings = [`board = [${Math.round(boardValue("columns"))}, ${Math.round(boardValue("rows"))}]`, `square_mm = ${boardValue("square_mm")}`,
    `board_thickness_mm = ${boardValue("thickness_mm")}`, ""].join("\n");
  const files = [textFile("calibration.toml", settings)];
  for (const folder of ["lens", "belt"]) {
    stills.filter((still) => still.folder === folder).forEach(({ bytes }, k) => {
      files.push({ name: `${folder}/${String(k + 1).padStart(3, "0")}.pgm`, bytes });
    });
  }
  return files;
}
export const textFile = (name, text) => ({ name, bytes: new TextEncoder().encode(text) });

// A file for the visitor: the folder of a stick, packed.
export function saveForStick(files, name) {
  const address = URL.createObjectURL(tar(files.map((file) => ({ ...file, name: `beltgauge/${file.name}` }))));
  h("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60000);
}

// The files of such an archive, without the folder; of what else is in it nothing.
export function untar(buffer) {
  const files = [];
  for (let at = 0; at + 512 <= buffer.byteLength;) {
    const field = (start, length) => new TextDecoder().decode(new Uint8Array(buffer, at + start, length)).split("\0")[0];
    const [name, size, kind] = [field(0, 100), parseInt(field(124, 12), 8), field(156, 1)];
    if (!name || !(size >= 0) || at + 512 + size > buffer.byteLength) break;
    const plain = name.replace(/^\.?\/?beltgauge\//, "");
    if ((kind === "0" || kind === "") && plain !== name) files.push({ name: plain, bytes: new Uint8Array(buffer, at + 512, size) });
    at += 512 + Math.ceil(size / 512) * 512;
  }
  return files;
}

// A tar archive (POSIX ustar) of files: name, bytes.
function tar(files) {
  const blocks = files.flatMap(({ name, bytes }) => [header(name, bytes.byteLength), bytes, new Uint8Array((512 - (bytes.byteLength % 512)) % 512)]);
  return new Blob([...blocks, new Uint8Array(1024)], { type: "application/x-tar" });
}

function header(name, size) {
  const block = new Uint8Array(512);
  const put = (at, text) => block.set(new TextEncoder().encode(text), at);
  const octal = (value, digits) => `${value.toString(8).padStart(digits, "0")}\0`;
  put(0, name);
  put(100, octal(0o644, 7));
  put(108, octal(0, 7));
  put(116, octal(0, 7));
  put(124, octal(size, 11));
  put(136, octal(Math.floor(Date.now() / 1000), 11));
  put(148, "        ");
  put(156, "0");
  put(257, "ustar\0" + "00");
  put(148, `${octal(block.reduce((sum, byte) => sum + byte, 0), 6)} `);
  return block;
}
