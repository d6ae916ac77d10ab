// Stills of the board that were kept in this browser, which survive that the page is loaded again, and
// the archive that takes them to a USB stick.

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

// A tar archive (POSIX ustar) of files: name, bytes.
export function tar(files) {
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
