// A document for tests under node: elements with listeners, attributes and children, but without layout or pictures.

class FakeElement {
  constructor(tag) {
    this.tag = tag;
    this.children = [];
    this.listeners = {};
    this.attributes = {};
    this.dataset = {};
    this.style = { setProperty: (name, value) => (this.style[name] = value) };
    this.hidden = this.disabled = this.checked = false;
    this.value = "";
    this.selectedIndex = -1;
    this.clientWidth = 0; // too narrow to be drawn on
    this.parentElement = tag === "parent" ? null : new FakeElement("parent");
    const names = new Set();
    this.classList = {
      toggle: (name, on) => (on ? names.add(name) : names.delete(name)),
      contains: (name) => names.has(name),
    };
  }

  get textContent() {
    return this.children.map((child) => (typeof child === "string" ? child : child.textContent)).join("");
  }

  set textContent(text) {
    this.children = [String(text)];
  }

  append(...children) {
    this.children = this.children.filter((child) => !children.includes(child));
    this.children.push(...children);
  }

  replaceChildren(...children) {
    this.children = children;
  }

  setAttribute(name, value) {
    this.attributes[name] = String(value);
    if (name === "value") this.value = String(value);
  }

  getAttribute(name) {
    return this.attributes[name] ?? null;
  }

  addEventListener(type, act) {
    (this.listeners[type] ??= []).push(act);
  }

  /** What a user does: call the listeners, unless the element is disabled. */
  fire(type, event = {}) {
    if (this.disabled) return;
    (this.listeners[type] ?? []).forEach((act) => act({ type, target: this, preventDefault() {}, stopPropagation() {}, ...event }));
  }

  querySelectorAll(tag) {
    const below = this.children.filter((child) => typeof child !== "string");
    return below.flatMap((child) => [...(child.tag === tag ? [child] : []), ...child.querySelectorAll(tag)]);
  }

  querySelector(tag) {
    return this.querySelectorAll(tag)[0] ?? null;
  }

  cloneNode() {
    return Object.assign(new FakeElement(this.tag), { children: [...this.children], attributes: { ...this.attributes } });
  }

  matches() {
    return false;
  }

  scrollIntoView() {}

  getContext() {
    return null;
  }

  getBoundingClientRect() {
    return { left: 0, top: 0, width: 100, height: 100 };
  }
}

const ids = {};
globalThis.document = Object.assign(new FakeElement("document"), {
  documentElement: new FakeElement("html"),
  body: new FakeElement("body"),
  getElementById: (id) => (ids[id] ??= new FakeElement(id)),
  createElement: (tag) => new FakeElement(tag),
  createElementNS: (_, tag) => new FakeElement(tag),
});
globalThis.window = Object.assign(new FakeElement("window"), { innerWidth: 1280, setInterval });
globalThis.matchMedia = () => Object.assign(new FakeElement("media"), { matches: false });
globalThis.getComputedStyle = () => ({ getPropertyValue: () => "" });
globalThis.location = { hash: "" };
globalThis.history = { replaceState() {} };

const $ = (id) => document.getElementById(id);
const later = (milliseconds = 0) => new Promise((resolve) => setTimeout(resolve, milliseconds));
